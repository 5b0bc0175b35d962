"""Time of one frame of the OpenGL rasterizer at several zooms, as a markdown table.

    python benchmarks/gl_frame.py --per-pixel 16 --size 640 360

Medians; on software OpenGL the CPU time says more than the wall time where the machine is busy.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from fields import plane

from gsasr.rasterize import gl
from gsasr.view import View

ZOOMS = (1, 2, 4, 8, 12, 16, 64, 1000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, nargs=2, default=(640, 360), help="of the frame, W H")
    parser.add_argument("--per-pixel", type=int, default=16, help="Gaussians per source pixel")
    parser.add_argument("--std", type=float, nargs=2, default=(0.2, 0.55), help="least, greatest")
    parser.add_argument("--zooms", type=float, nargs="+", default=ZOOMS)
    parser.add_argument("--frames", type=int, default=9)
    arguments = parser.parse_args()
    width, height = arguments.size

    ctx = gl.create_context()
    rasterizer = gl.GlRasterizer(ctx)
    target = ctx.texture((width, height), 4, dtype="f2")
    print(f"{ctx.info['GL_RENDERER']}, {width}x{height}, {arguments.per_pixel} per pixel\n")
    print("| zoom | wall, ms | CPU, ms | packing, s | list | sum |")
    print("|---|---|---|---|---|---|")
    for zoom in arguments.zooms:
        sides = [int(np.ceil(length / zoom)) + 4 for length in (height, width)]
        gaussians = plane(*sides, arguments.per_pixel, arguments.std)
        start = time.perf_counter()
        packed = [gl.pack(part) for part in gl.split_tiles(gaussians)]
        packing = time.perf_counter() - start
        tiles = [rasterizer.upload(tile) for tile in packed]
        lists = sum(len(tile.levels[0].entries) for tile in packed) / np.prod(sides)
        view = View((2.1, 2.2), (zoom, zoom), (height, width))
        wall, cpu = [], []
        for _ in range(arguments.frames + 1):
            ctx.finish()
            before = time.perf_counter(), time.process_time()
            rasterizer.draw(tiles, view, target)
            ctx.finish()
            wall.append(time.perf_counter() - before[0])
            cpu.append(time.process_time() - before[1])
        mean = np.frombuffer(target.read(), np.float16).astype(np.float32).mean()
        print(
            f"| {zoom:g} | {1e3 * np.median(wall[1:]):.1f} | {1e3 * np.median(cpu[1:]):.1f} "
            f"| {packing:.2f} | {lists:.0f} | {mean:.3f} |",
            flush=True,
        )
        for tile in tiles:
            tile.release()


if __name__ == "__main__":
    main()
