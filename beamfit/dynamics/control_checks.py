"""Checks of the limits and the targets of a loop, before anything is identified; without JAX."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from beamfit.errors import InputError


def range_text(low: float, high: float) -> str:
    """Write a range of which one end may be infinite."""
    if math.isfinite(low) and math.isfinite(high):
        return f"{low:.4g} to {high:.4g}"
    return f"at most {high:.4g}" if math.isfinite(high) else f"at least {low:.4g}"


def check_limits(limits: Mapping[str, tuple[float, float]]) -> None:
    """Refuse limits that are no range."""
    for name, (low, high) in limits.items():
        if not low < high:
            raise InputError(f"limits {low:g} to {high:g} of {name}", "the lower one first")


def check_rates(rates: Mapping[str, float]) -> None:
    """Refuse rates that are not positive."""
    for name, rate in rates.items():
        if not rate > 0:
            raise InputError(f"rate {rate:g} of {name}", "above 0, in units a second")


def check_steps(steps: Sequence[tuple[str, float, float]], end: float = math.inf) -> None:
    """Refuse values of targets or disturbances that are not finite, and times outside the loop."""
    for name, value, at in steps:
        if not 0 <= at < end:
            inside = f", 0 to {end:g} s" if math.isfinite(end) else ": 0 s or later"
            raise InputError(f"{name} at {at:g} s", f"a time within the loop{inside}")
        if not math.isfinite(value):
            raise InputError(f"{value:g} for {name}", "a finite number")


def check_targets(
    targets: Sequence[tuple[str, float, float]], limits: Mapping[str, tuple[float, float]]
) -> None:
    """Refuse targets outside the limits of their outputs, where these have any."""
    for name, value, _ in targets:
        low, high = limits.get(name, (-math.inf, math.inf))
        if not low <= value <= high:
            raise InputError(f"{name} wanted at {value:g}", f"{range_text(low, high)}, its limits")
