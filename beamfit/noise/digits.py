"""Digits of readings: their step, and the error of rounding that is the same at each return."""

from __future__ import annotations

import numpy as np

# What differences of readings are off multiples of a digit at most, of so many of them.
EXACT, ENOUGH = 1e-3, 4096
# No digit is smaller than this share of the readings: their own accuracy is below 1e-3 of it.
LEAST = 1e-12
# Sines of the error of rounding: the sum of their squares is right to 3 %.
SINES = 20


def digit_of(values: np.ndarray) -> float | None:
    """The step of which all differences are multiples; None where there is none, as of values that
    are held until the next. Where readings seldom repeat, those of an exact line are none either.

    Examples
    --------
    >>> digit_of(np.array([1.0, 1.5, 1.5, 3.0, 1.0, 1.0])), digit_of(np.array([1.0, 4.0, 6.0]))
    (0.5, 1.0)
    """
    levels = np.unique(values)
    if levels.size < 2:
        return None
    steps = np.diff(levels)
    step, steps = float(steps.min()), steps[:ENOUGH]
    off = np.abs(steps / step - np.round(steps / step))
    if levels.size <= values.size / 2:
        return step if float(np.median(off)) < 0.1 else None
    while off.max() >= EXACT:  # the largest common divisor
        step *= float(off[off >= EXACT].min())
        if step < LEAST * np.abs(levels).max():
            return None
        off = np.abs(steps / step - np.round(steps / step))
    a_line = levels.size == values.size and steps.max() < 1.5 * step
    return None if a_line else step


def rounding_variance(digit: float, noise: float) -> float:
    """Variance of the mean error of rounded readings, over the values that they may be of.

    Without noise it is digit²/12. The error is a sawtooth of the value, of whose sines noise leaves
    what its characteristic function is at their frequency (B. Widrow, I. Kollár, Quantization Noise
    (2008), on dither).

    Examples
    --------
    >>> [round(rounding_variance(1.0, noise), 4) for noise in (0.0, 0.2, 0.5)]
    [0.0809, 0.0105, 0.0]
    """
    k = np.arange(1, SINES + 1)
    left = np.exp(-((2 * np.pi * k * noise / digit) ** 2))
    return float(digit**2 / (2 * np.pi**2) * np.sum(left / k**2))
