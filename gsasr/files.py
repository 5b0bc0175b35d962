"""Writing files without ever leaving half of one, and finding the files we ship."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import GsasrError


@contextmanager
def writing(path: str | os.PathLike, error: type[GsasrError]) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` if the block succeeds.

    A failed block leaves nothing behind, and an older file at `path` untouched. An OSError
    (full disk, no permission, no such folder) becomes `error` with one clear sentence.
    """
    path = Path(path)
    check_writable(path, error)
    beside = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        beside.touch()
        mode = beside.stat().st_mode  # some writers make the file anew, readable by its owner only
        yield beside
        beside.chmod(mode)
        os.replace(beside, path)
    except OSError as failure:
        reason = failure.strerror or str(failure)
        raise error(f"Cannot write {path}: {reason}; choose another folder.") from failure
    finally:
        with suppress(OSError):  # such as a folder that is none; the reason is already told
            beside.unlink()


def check_writable(path: str | os.PathLike, error: type[GsasrError]) -> None:
    """Raise `error` now if `path` cannot be written, before minutes of work, not after."""
    path = Path(path)
    if path.is_dir():
        raise error(f"{path} is a folder; give a file name in it.")
    if not path.parent.is_dir():
        raise error(f"The folder {path.parent} does not exist; create it first.")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise error(f"The folder {path.parent} is not writable; choose another.")


def shipped(name: str) -> Path:
    """Path of a shader or asset, e.g. "shaders/gaussian.glsl".

    A wheel carries the folders inside the package; a checkout has them beside it.
    """
    package = Path(__file__).parent
    inside = package / name
    return inside if inside.exists() else package.parent / name
