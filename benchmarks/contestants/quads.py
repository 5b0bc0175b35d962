"""No index: the graphics pipeline draws a rectangle per Gaussian and adds what it covers."""

from __future__ import annotations

import time

import moderngl
import numpy as np

from gsasr.gaussians import Gaussians
from gsasr.view import View

from .contestant import FOLD, GlContestant, drawn, pixels_in_boxes, shader, whole_and_rest


class Quads(GlContestant):
    """Instanced: one quad per Gaussian, the box of its cut ellipse, blended by addition."""

    name = "quads"

    def __init__(self, ctx: moderngl.Context, field: Gaussians) -> None:
        super().__init__(ctx)
        self._program = ctx.program(shader(ctx, "quads.vert"), shader(ctx, "quads.frag"))
        start = time.perf_counter()
        records, cut = drawn(field)
        a, b, c = records[:, 2:5].T
        reach = FOLD * np.sqrt(cut)[:, None] * np.stack([np.hypot(1, b / c) / a, 1 / c], axis=1)
        instances = np.concatenate([records, reach.astype(np.float32)], axis=1)
        self.seconds = {1: time.perf_counter() - start}
        self.gaussians, self.index = instances.nbytes, 0
        self._boxes = instances[:, :2].copy(), instances[:, 8:].copy()
        self._buffer = ctx.buffer(instances) if len(instances) else ctx.buffer(reserve=40)
        layout = (self._buffer, "2f 3f 3f 2f /i", "mean", "whitening", "peak", "reach")
        self._array = ctx.vertex_array(self._program, [layout])

    def draw(self, view: View) -> None:
        framebuffer = self.ctx.framebuffer([self.target(view)])
        framebuffer.clear(alpha=1.0)
        base, rest = whole_and_rest(view.origin)
        values = {"base": base, "fraction": rest, "scale": view.scale, "size": view.size[::-1]}
        for name, value in values.items():
            self._program[name] = value
        self.ctx.blend_func = moderngl.ONE, moderngl.ONE
        with self.ctx.scope(framebuffer, enable_only=moderngl.BLEND):
            self._array.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(self._boxes[0]))
        framebuffer.release()

    def evaluations(self, view: View) -> int:
        return int(pixels_in_boxes(*self._boxes, view).sum())

    def release(self) -> None:
        super().release()
        for held in (self._array, self._buffer, self._program):
            held.release()


class HalfQuads(Quads):
    """The same with 16 bits per channel: half the traffic, but long sums lose their last bits."""

    name = "quads, 16 bit"
    dtype = "f2"
