"""What a pixel costs, learned from the frames drawn so far."""

from __future__ import annotations

import math

WEIGHT = 0.3  # of a new measurement, where it is below what was expected


class Rates:
    """Seconds per pixel by the scale that is drawn at.

    A pixel of half the scale shows four times the Gaussians. So what is known of one scale bounds
    another from above: a pixel costs no more at a larger scale, and at a smaller one no more than
    in proportion to the picture's area that it shows. Each octave of scales is learned apart; one
    not seen yet is judged by the nearest. What is dearer than expected counts at once, what is
    cheaper only by and by, since a frame too coarse is a lesser evil than one too late.
    """

    def __init__(self, guess: float) -> None:
        """guess: seconds per pixel at scale 1."""
        self._known = {0: (1.0, guess)}  # octave: scale, seconds per pixel

    def predict(self, scale: float) -> float:
        """Seconds per pixel at a scale (output pixels per source pixel)."""
        octave = _octave(scale)
        known, seconds = self._known[min(self._known, key=lambda other: abs(other - octave))]
        return seconds * max(1.0, known / scale) ** 2

    def learn(self, scale: float, seconds: float) -> None:
        """A pixel took so many seconds at a scale (output pixels per source pixel)."""
        octave = _octave(scale)
        if octave in self._known:
            expected = self.predict(scale)
            seconds = max(seconds, expected + WEIGHT * (seconds - expected))
        self._known[octave] = scale, max(seconds, 1e-12)


def _octave(scale: float) -> int:
    return round(math.log2(scale))
