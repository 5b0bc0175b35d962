"""--snapshot: the same view as the window's, rendered without one."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gsasr import image
from gsasr.errors import BackendError, RequestError
from gsasr.view import View

from .camera import Camera
from .loading import Loader
from .scene import Overlay, Scene, Target
from .state import Document
from .store import TileStore
from .worker import Task


def run(options: argparse.Namespace) -> None:
    """Render options.file as the canvas of the window would show it, and write it.

    Only the tiles that the view needs are predicted. Raises GsasrError; nothing is left of a
    file that could not be written.
    """
    image.check_output(options.snapshot)
    task, loader = Task("Snapshot"), Loader()
    document = loader.open(task, Path(options.file))
    camera = _camera(options, document)
    view = camera.view()
    scene = Scene(_context())
    scene.set_picture(document.pixels)
    if view.scale[0] > 1 or options.overlay != "none":
        if document.tiles is None:
            document.tiles, _ = loader.plan(task, document, options.model, options.condition)
        from gsasr.rasterize.driver import video_memory

        _fill(scene, document.tiles, view, options.gpu_memory or video_memory(scene.ctx).budget)
    height, width = view.size
    target = Target(scene.ctx, (height, width))
    scene.draw(target, view, Overlay(options.overlay, options.sigma))
    image.write(options.snapshot, target.read().astype(np.float32) / 255)


def _context():
    from gsasr.rasterize.opengl import create_context

    try:
        return create_context()
    except BackendError as error:
        raise BackendError(
            "No headless OpenGL 4.3 here; install a GPU driver or Mesa (libegl1 and "
            "libgl1-mesa-dri), or render with gsasr upscale, which needs none."
        ) from error


def _camera(options: argparse.Namespace, document: Document) -> Camera:
    camera = Camera()
    camera.resize(*options.size)
    camera.set_picture(document.size)
    if options.zoom is not None or options.center is not None:
        height, width = document.size
        x, y = options.center or (width / 2, height / 2)
        if not (0 <= x <= width and 0 <= y <= height):
            raise RequestError(
                f"The point of --center lies outside of the {width}x{height} picture."
            )
        camera.look_at(x, y, options.zoom or camera.fit_scale)
    return camera


def _fill(scene: Scene, tiles: TileStore, view: View, memory: int) -> None:
    """Have the scene draw the tiles of a view, with a progress bar where somebody may watch it.

    memory: bytes that they may take on the GPU. Raises RequestError if they take more.
    """
    from gsasr.rasterize.gl import pack, split_tiles

    scene.prepare()
    visible, held = tiles.visible(view), 0
    for index in tqdm(visible, "Gaussians", disable=None, bar_format="{l_bar}{bar}"):
        for piece in split_tiles(tiles.gaussians(index), most=scene.most):
            scene.add_tile(pack(piece))
        held += scene.cover(tiles.cores[index])
        if held > memory:
            raise RequestError(
                f"The view shows more Gaussians than the {memory / 2**20:.0f} MiB for them on the "
                "GPU can hold; raise --gpu-memory, --zoom in further, or use gsasr upscale."
            )
