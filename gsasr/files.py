"""Writing files without ever leaving half of one, and finding the files we ship."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from safetensors import SafetensorError

from .errors import GsasrError


@contextmanager
def writing(path: str | os.PathLike, error: type[GsasrError]) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` if the block succeeds.

    A failed block leaves nothing behind, and an older file at `path` untouched. An OSError
    (full disk, no permission, no such folder) becomes `error` with one clear sentence.
    """
    check_writable(path, error)
    path = Path(path).resolve()  # through a link, not instead of it
    beside = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        beside.touch()
        mode = beside.stat().st_mode  # some writers make the file anew, readable by its owner only
        yield beside
        beside.chmod(mode)
        os.replace(beside, path)
    except (OSError, SafetensorError) as failure:
        reason = getattr(failure, "strerror", None) or str(failure)
        raise error(f"Cannot write {path}: {reason}; choose another folder.") from failure
    finally:
        with suppress(OSError):  # such as a folder that is none; the reason is already told
            beside.unlink()


def check_writable(path: str | os.PathLike, error: type[GsasrError]) -> None:
    """Raise `error` now if `path` cannot be written, before minutes of work, not after."""
    path = Path(path)
    try:
        path.lstat()
        there = True
    except FileNotFoundError:
        there = False
    except OSError as failure:  # a name too long, a folder that may not be entered
        raise error(f"Cannot write {path}: {failure.strerror}; choose another file.") from failure
    if path.is_dir():
        raise error(f"{path} is a folder; give a file name in it.")
    if there and path.exists() and not path.is_file():
        raise error(f"{path} is no ordinary file; choose another.")
    if not path.parent.is_dir():
        raise error(f"The folder {path.parent} does not exist; create it first.")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise error(f"The folder {path.parent} is not writable; choose another.")


def require_file(path: str | os.PathLike, error: type[GsasrError]) -> Path:
    """`path`, or `error` with the reason if it is no file that can be read."""
    path = Path(path)
    try:
        with path.open("rb"):
            return path
    except FileNotFoundError as failure:
        raise error(f"{path} does not exist; check the path.") from failure
    except IsADirectoryError as failure:
        raise error(f"{path} is a folder, not a file; check the path.") from failure
    except OSError as failure:
        raise error(
            f"{path} cannot be read: {failure.strerror}; check its permissions."
        ) from failure


def shipped(name: str) -> Path:
    """Path of a shader or asset, e.g. "shaders/gaussian.glsl".

    A wheel carries the folders inside the package; a checkout has them beside it.
    """
    package = Path(__file__).parent
    inside = package / name
    return inside if inside.exists() else package.parent / name
