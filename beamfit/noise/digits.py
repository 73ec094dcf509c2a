"""Digit (resolution) of readings, and the rounding error that repeats at equal values."""

from __future__ import annotations

import numpy as np

# Differences of readings are multiples of the digit to this share of it; number that is tested.
MULTIPLE_TOLERANCE, MAX_DIFFERENCES = 1e-3, 4096
# Smallest digit as a share of the readings, whose own rounding is below 1e-3 of it.
MIN_DIGIT = 1e-12
# Terms of the Fourier series of the rounding error: the sum of their squares is right to 3 %.
FOURIER_TERMS = 20


def digit_of(values: np.ndarray) -> float | None:
    """Find the step of which all differences of readings are multiples; None if there is none.

    Readings that are held until the next one have none. If readings rarely repeat, neither have
    those of an exact line.
    Examples
    --------
    >>> digit_of(np.array([1.0, 1.5, 1.5, 3.0, 1.0, 1.0])), digit_of(np.array([1.0, 4.0, 6.0]))
    (0.5, 1.0)
    """
    levels = np.unique(values)
    if levels.size < 2:
        return None
    steps = np.diff(levels)
    step, steps = float(steps.min()), steps[:MAX_DIFFERENCES]
    remainder = np.abs(steps / step - np.round(steps / step))
    if levels.size <= values.size / 2:
        return step if float(np.median(remainder)) < 0.1 else None
    while remainder.max() >= MULTIPLE_TOLERANCE:  # the largest common divisor
        step *= float(remainder[remainder >= MULTIPLE_TOLERANCE].min())
        if step < MIN_DIGIT * np.abs(levels).max():
            return None
        remainder = np.abs(steps / step - np.round(steps / step))
    line = levels.size == values.size and steps.max() < 1.5 * step
    return None if line else step


def rounding_variance(digit: float, noise: float) -> float:
    """Variance of the mean error of rounded readings, over the values that they may have.

    Without noise it is digit²/12. The error is a sawtooth of the value. Noise multiplies each of
    its Fourier terms by the characteristic function of the noise at that frequency (B. Widrow, I.
    Kollár, Quantization Noise (2008), on dither).

    Examples
    --------
    >>> [round(rounding_variance(1.0, noise), 4) for noise in (0.0, 0.2, 0.5)]
    [0.0809, 0.0105, 0.0]
    """
    k = np.arange(1, FOURIER_TERMS + 1)
    damping = np.exp(-((2 * np.pi * k * noise / digit) ** 2))
    return float(digit**2 / (2 * np.pi**2) * np.sum(damping / k**2))
