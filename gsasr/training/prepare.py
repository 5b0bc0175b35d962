"""Pictures as found -> pictures as training wants them: checked and cut up, or in pairs."""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from .. import imresize
from ..errors import DataError, ImageError, RequestError
from ..files import writing
from .data import find_pictures, load
from .processes import die_with_parent, fresh_processes

SETTINGS = "prepared.json"  # in the output folder: what it was made with
COMPRESSION = 3  # of PNG: a fifth larger than the default of 6, written twice as fast


@dataclass(frozen=True)
class Pieces:
    """Overlapping pieces for training.

    smallest: pictures with a shorter side (pixels) are left out. size: side of a piece, or that
    of the picture where it is shorter. step: from one piece to the next. rest: where more pixels
    than this remain after the last piece, one more is cut flush with the edge.
    """

    smallest: int = 192
    size: int = 480
    step: int = 240
    rest: int = 0

    def __post_init__(self) -> None:
        if min(self.smallest, self.size, self.step) < 1 or self.rest < 0:
            raise RequestError("size, step and smallest must be at least 1, rest at least 0.")
        if self.size < self.smallest:
            raise RequestError("A piece must not be smaller than the smallest picture.")

    def starts(self, length: int) -> list[int]:
        """Where pieces begin along a side of `length` pixels."""
        starts = list(range(0, max(1, length - self.size + 1), self.step))
        if length - starts[-1] - self.size > self.rest:
            starts.append(length - self.size)
        return starts

    def files(self, name: str, height: int, width: int) -> list[str]:
        """The files a picture of this size becomes, below the output folder."""
        count = len(self.starts(height)) * len(self.starts(width))
        return [f"{name}_{number:03d}.png" for number in range(1, count + 1)]

    def cut(self, picture: np.ndarray) -> list[np.ndarray]:
        """(H, W, 3) -> the contents of these files."""
        height, width = picture.shape[:2]
        return [
            picture[top : top + self.size, left : left + self.size]
            for top in self.starts(height)
            for left in self.starts(width)
        ]


@dataclass(frozen=True)
class Pairs:
    """Pairs for validation, laid out like the benchmarks; LR by MATLAB's bicubic.

    smallest: pictures with a shorter side (pixels) are left out. scales: whole numbers; the HR
    picture is cut at the bottom and right to a multiple of all of them.
    """

    smallest: int = 192
    scales: tuple[int, ...] = (2, 3, 4)

    def __post_init__(self) -> None:
        if not self.scales or min(self.scales) < 2 or self.smallest < math.lcm(*self.scales):
            raise RequestError(
                "scales must be at least 2, and smallest at least their least common multiple."
            )

    def files(self, name: str, height: int, width: int) -> list[str]:
        name = name.replace("/", "-")
        return [f"HR/{name}.png", *(f"LR/x{scale}/{name}.png" for scale in self.scales)]

    def cut(self, picture: np.ndarray) -> list[np.ndarray]:
        multiple = math.lcm(*self.scales)
        height, width = (side // multiple * multiple for side in picture.shape[:2])
        truth = picture[:height, :width]
        return [truth, *(imresize.downscale(truth, scale) for scale in self.scales)]


Task = Pieces | Pairs


def prepare(folder: str | os.PathLike, out: str | os.PathLike, task: Task, workers: int = 1) -> str:
    """Do the task for every picture below `folder`; returns a summary of a few lines.

    Pictures are read in `workers` processes. Broken and small ones are left out and named. Files
    are complete or absent, and those that are already there and newer than their picture are not
    made again.

    Raises DataError if there is nothing to do, nothing usable, no room, or another task's output.
    """
    folder, out = Path(folder), Path(out)
    if workers < 1:
        raise RequestError("workers must be at least 1.")
    paths = find_pictures(folder)
    if out.resolve() == folder.resolve() or folder.resolve() in out.resolve().parents:
        raise DataError(f"{out} lies in {folder}; choose a folder outside the pictures.")
    _claim(out, task)
    made, kept, problems = 0, 0, []
    with (
        tqdm(total=len(paths), unit="picture", disable=None) as bar,
        ProcessPoolExecutor(
            min(workers, len(paths)), fresh_processes(__name__), die_with_parent
        ) as pool,
    ):
        try:
            waiting: set[Future] = set()
            for path, name in zip(paths, _names(paths, folder), strict=True):
                waiting.add(pool.submit(_one, path, name, out, task))
                while len(waiting) >= 4 * workers or (waiting and path is paths[-1]):
                    done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                    for result in (future.result() for future in done):
                        made, kept = made + result.made, kept + result.kept
                        problems += result.problem
                        bar.update()
        except BrokenProcessPool as error:
            raise DataError(
                "A process was stopped, likely for lack of memory; use fewer --workers."
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    if not made + kept:
        raise DataError(
            f"None of the {len(paths)} pictures in {folder} can be used, such as: {min(problems)}"
        )
    again = f" ({kept} were there already)" if kept else ""
    lines = [f"{len(paths) - len(problems)} of {len(paths)} pictures became {made + kept} files"]
    lines[0] += f"{again} in {out}."
    return "\n".join(lines + [f"left out: {problem}" for problem in sorted(problems)])


@dataclass(frozen=True)
class _Result:
    """made, kept: files. problem: at most one sentence, why the picture was left out."""

    made: int = 0
    kept: int = 0
    problem: tuple[str, ...] = ()


def _one(path: Path, name: str, out: Path, task: Task) -> _Result:
    """One picture, in a process of the pool. Raises DataError if its files cannot be written."""
    done = _already(path, name, out, task)
    if done:
        return _Result(kept=done)
    try:
        picture = load(path).numpy()
    except ImageError as error:
        return _Result(problem=(str(error),))
    height, width = picture.shape[:2]
    if min(height, width) < task.smallest:
        return _Result(problem=(f"{path} has only {width}x{height} pixels.",))
    files = task.files(name, height, width)
    for file, part in zip(files, task.cut(picture), strict=True):
        target = out / file
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DataError(f"Cannot make the folder {target.parent}: {error.strerror}.") from error
        with writing(target, DataError) as beside:
            Image.fromarray(part).save(beside, "PNG", compress_level=COMPRESSION)
    return _Result(made=len(files))


def _already(path: Path, name: str, out: Path, task: Task) -> int:
    """How many files there are if all of this picture's are there and newer than it, else 0."""
    try:
        with Image.open(path) as header:
            width, height = header.size
            if header.getexif().get(0x0112, 1) >= 5:  # stored on its side
                width, height = height, width
        files = [out / file for file in task.files(name, height, width)]
        born = path.stat().st_mtime
        return len(files) if all(file.stat().st_mtime >= born for file in files) else 0
    except Exception:  # not there yet, or a picture that the decoder will complain about
        return 0


def _names(paths: list[Path], folder: Path) -> list[str]:
    """A name without suffix for each picture, with the suffix where two would be equal."""
    names = [path.relative_to(folder).with_suffix("").as_posix() for path in paths]
    shared = Counter(name.lower().replace("/", "-") for name in names)
    return [
        path.relative_to(folder).as_posix() if shared[name.lower().replace("/", "-")] > 1 else name
        for path, name in zip(paths, names, strict=True)
    ]


def _claim(out: Path, task: Task) -> None:
    """Note in the output folder what it is made with; DataError if that was something else."""
    note = out / SETTINGS
    wanted = {"task": type(task).__name__.lower()} | asdict(task)
    wanted = json.loads(json.dumps(wanted))
    try:
        out.mkdir(parents=True, exist_ok=True)
        if note.exists():
            if json.loads(note.read_text()) != wanted:
                raise DataError(f"{out} was made with other settings (see {note}); choose another.")
        elif any(not entry.name.startswith(".") for entry in out.iterdir()):
            raise DataError(f"{out} is not empty; choose a new folder.")
    except (OSError, ValueError) as error:
        raise DataError(f"Cannot use the folder {out}: {error}; choose another.") from error
    with writing(note, DataError) as beside:
        beside.write_text(json.dumps(wanted, indent=2) + "\n")
