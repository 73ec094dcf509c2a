"""The rms of a beam's projection on a screen."""

from __future__ import annotations

import numpy as np
from scipy.optimize import curve_fit

# Heights over the scatter of the background below which a projection shows no beam.
SEEN = 5.0
# A Gaussian is within 1 % of its height over 0.28 of its size: a top wider than this, and some
# pixels, is cut off by the camera.
FLAT, PIXELS = 0.6, 2
# Share of the projection at either end that is background, to begin with.
ENDS = 0.1


def rms_of(counts: np.ndarray, pixel: float) -> float | None:
    """Rms size of a projection: that of a Gaussian on a level background.

    Parameters
    ----------
    counts : ndarray
        Shape (n,), the projection.
    pixel : float
        Size of a pixel at the screen, m.

    Returns
    -------
    float or None
        m; None where there is no beam, its spot does not fit on the screen, or its top is cut off.

    Notes
    -----
    Least squares of h exp(-(x - x0)²/(2 s²)) + c, the size most laboratories quote; moments depend
    on where the background is cut.

    Examples
    --------
    >>> x = np.arange(200.0)
    >>> round(1e6 * rms_of(900 * np.exp(-0.5 * ((x - 90) / 12) ** 2) + 20, 10e-6), 3)
    120.0
    """
    n = counts.size
    if n < 8 or not np.isfinite(counts).all():
        return None
    place, few = np.arange(n, dtype=float), max(int(ENDS * n), 2)
    ends = np.concatenate([counts[:few], counts[-few:]])
    level, scatter = float(np.median(ends)), float(np.std(ends))
    height = float(counts.max() - level)
    if height <= SEEN * scatter or height <= 0:
        return None
    above = counts - level > 0.5 * height
    width = max(above.sum() / 2.355, 1.0)
    start = (height, float(place[above].mean()), width, level)
    try:
        found, _ = curve_fit(_gaussian, place, counts, start, maxfev=400)
    except RuntimeError:  # which has no minimum within 400 steps
        return None
    size = abs(float(found[2]))
    inside = 0 < found[1] < n - 1 and found[0] > 0 and 0.3 < size < n / 4
    flat = np.count_nonzero(counts - level > 0.99 * height) > PIXELS + FLAT * size
    return size * pixel if inside and not flat else None


def _gaussian(x: np.ndarray, height: float, middle: float, size: float, level: float) -> np.ndarray:
    return height * np.exp(-0.5 * ((x - middle) / size) ** 2) + level
