#!/usr/bin/env bash
# Open a sample picture in the viewer, or draw what it would show where there is no display.
# demo.sh [PICTURE]
set -euo pipefail
cd "$(dirname "$0")/.."

picture=${1:-assets/images/astronaut.png}
viewer=.venv/bin/gsasr-viewer

if [ -n "${DISPLAY:-}${WAYLAND_DISPLAY:-}" ]; then
    echo "demo: scroll to zoom into $picture, drag to pan; make demo PICTURE=... opens another."
    exec $viewer "$picture"
fi

echo "demo: there is no display, so the pictures go to $PWD/demo."
mkdir -p demo
snapshot() { # NAME OPTIONS...
    $viewer "$picture" --snapshot "demo/$1.png" --size 1280x720 "${@:2}"
    echo "demo: demo/$1.png"
}
snapshot whole --zoom 2.5 --overlay none
snapshot zoom8 --zoom 8 --overlay none
snapshot gaussians --zoom 24 --overlay ellipses
