#!/usr/bin/env bash
# Make .venv with everything that the demo and the tests need. Safe to run again at any time:
# when nothing changed it returns at once. PYTHON=python3.12 chooses the interpreter.
set -euo pipefail
cd "$(dirname "$0")/.."

VENV=.venv
STAMP=$VENV/gsasr-setup     # what the finished set-up was made from
STARTED=$VENV/gsasr-started # present while a new .venv is being filled
LOG=.cache/setup.log

say() { echo "setup: $*" >&2; }
fail() { say "$*"; exit 1; }
recipe() { pwd; cat constraints.txt pyproject.toml scripts/setup.sh; }
works() { [ -x $VENV/bin/python ] && $VENV/bin/python -c '' 2>/dev/null; }
done_already() { recipe | cmp -s - $STAMP && works; }

# Which Debian package brings which library or program. Windows and OpenGL need the first group,
# rendering without a GPU the Mesa drivers, the tests of the window Xvfb, those of the CUDA
# kernels on machines without a GPU a C++ compiler.
missing_packages() {
    local libraries name package
    libraries=$(PATH=$PATH:/usr/sbin:/sbin ldconfig -p 2>/dev/null || true)
    while read -r name package; do
        grep -q "^[[:space:]]*$name " <<<"$libraries" || echo "$package"
    done <<-LIST
		libEGL.so.1 libegl1
		libEGL_mesa.so.0 libegl-mesa0
		libGL.so.1 libgl1
		libGLX_mesa.so.0 libglx-mesa0
		libGLESv2.so.2 libgles2
		libX11.so.6 libx11-6
		libX11-xcb.so.1 libx11-xcb1
		libXcursor.so.1 libxcursor1
		libXext.so.6 libxext6
		libXi.so.6 libxi6
		libXinerama.so.1 libxinerama1
		libXrandr.so.2 libxrandr2
		libXrender.so.1 libxrender1
	LIST
    command -v Xvfb >/dev/null || echo xvfb
    command -v xauth >/dev/null || echo xauth
    command -v c++ >/dev/null || command -v clang++ >/dev/null || echo g++
}

install_packages() { # the names; installs them, or says how
    if ! command -v apt-get >/dev/null; then
        say "these system packages seem to be missing (Debian's names): $*"
    elif [ "$(id -u)" != 0 ]; then
        say "for the window and the tests, run: sudo apt-get install -y $*"
    else
        say "installing system packages: $*"
        export DEBIAN_FRONTEND=noninteractive
        { apt-get install -y --no-install-recommends "$@" ||
            { apt-get update && apt-get install -y --no-install-recommends "$@"; }
        } </dev/null >>$LOG 2>&1 || say "apt-get failed (see $LOG); install them by hand: $*"
    fi
}

find_python() {
    local name
    for name in ${PYTHON:-python3 python3.13 python3.12 python3.11}; do
        if "$name" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' \
            2>/dev/null; then
            command -v "$name"
            return
        fi
    done
    fail "no Python 3.11 to 3.13 found; install python3 and python3-venv, or set PYTHON=..."
}

make_venv() {
    local python
    python=$(find_python)
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        local package
        package=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
        install_packages "$package"
        "$python" -c 'import ensurepip, venv' 2>/dev/null ||
            fail "$python has no venv module; install $package."
    fi
    say "making $VENV with $("$python" --version)"
    rm -rf $VENV
    mkdir $VENV
    touch $STARTED
    "$python" -m venv $VENV >>$LOG 2>&1 || fail "could not make $VENV; see $LOG."
}

done_already && exit 0

mkdir -p .cache
if command -v flock >/dev/null; then # a second set-up at the same time waits, then finds it done
    exec 9>.cache/setup.lock
    flock -n 9 || { say "waiting for another set-up to finish"; flock 9; }
    done_already && exit 0
fi
: >$LOG

mapfile -t packages < <(missing_packages)
[ ${#packages[@]} = 0 ] || install_packages libgl1-mesa-dri "${packages[@]}"

if ! works || [ -e $STARTED ]; then
    make_venv
fi
rm -f $STAMP
say "installing Python packages (minutes the first time; log in $LOG)"
if ! $VENV/bin/python -m pip install --disable-pip-version-check --no-input \
    -c constraints.txt -e '.[dev]' </dev/null >>$LOG 2>&1; then
    tail -n 15 $LOG >&2
    fail "pip could not install the packages; the lines above say why (whole log in $LOG)."
fi
say "looking at what this machine has, and compiling shaders"
$VENV/bin/gsasr doctor >>$LOG 2>&1 || true # only a first look; the viewer compiles what is missing
recipe >$STAMP.new
mv $STAMP.new $STAMP
rm -f $STARTED
say "done"
