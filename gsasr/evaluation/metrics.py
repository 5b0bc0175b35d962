"""PSNR and SSIM on luma."""

from __future__ import annotations

import numpy as np

_LUMA = np.array([65.481, 128.553, 24.966])  # BT.601, [0, 1] RGB -> [16, 235]


def to_8bit(picture: np.ndarray) -> np.ndarray:
    """Float picture, clipped to [0, 1] and rounded to 8-bit levels (still [0, 1] floats)."""
    return np.rint(np.clip(picture, 0, 1) * 255) / 255


def luma(picture: np.ndarray) -> np.ndarray:
    """(H, W, 3) RGB in [0, 1] -> (H, W) Y in [16, 235], as MATLAB's rgb2ycbcr, not rounded."""
    return picture.astype(np.float64) @ _LUMA + 16.0


def psnr_y(picture: np.ndarray, truth: np.ndarray, border: int) -> float:
    """PSNR in dB on Y of (H, W, 3) pictures in [0, 1], each rounded to 8 bits first.

    border: pixels left out on each side; the literature uses the scale.
    """
    difference = _cropped(luma(to_8bit(picture)) - luma(to_8bit(truth)), border)
    error = float(np.mean(difference**2))
    return float("inf") if error == 0 else 10 * np.log10(255**2 / error)


def ssim_y(picture: np.ndarray, truth: np.ndarray, border: int) -> float:
    """SSIM on Y (Wang et al. 2004: 11x11 Gaussian window of 1.5, valid region, L = 255)."""
    a = _cropped(luma(to_8bit(picture)), border)
    b = _cropped(luma(to_8bit(truth)), border)
    mean_a, mean_b = _window(a), _window(b)
    var_a = _window(a * a) - mean_a**2
    var_b = _window(b * b) - mean_b**2
    covariance = _window(a * b) - mean_a * mean_b
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * covariance + c2) / (var_a + var_b + c2)
    return float(np.mean(luminance * structure))


def _cropped(plane: np.ndarray, border: int) -> np.ndarray:
    return plane[border : plane.shape[0] - border, border : plane.shape[1] - border]


def _window(plane: np.ndarray) -> np.ndarray:
    """Weighted mean in every full 11x11 window."""
    taps = np.exp(-((np.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    taps /= taps.sum()
    for axis in (0, 1):
        windows = np.lib.stride_tricks.sliding_window_view(plane, 11, axis=axis)
        plane = windows @ taps
    return plane
