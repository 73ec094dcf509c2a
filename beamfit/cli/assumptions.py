"""Priors, bounds and anchors as they are typed."""

from __future__ import annotations

import re

from beamfit.errors import InputError
from beamfit.studies.scan.assumptions import Anchor

__all__ = ["anchor_of", "bounds_of", "limits_of", "priors_of"]

PRIOR = "NAME=MEAN+-SD such as Q2.slope=167.23+-3.3446"
BOUNDS = "NAME=LOWER:UPPER such as Q2.slope=147.23:187.23"
VARY = "MAGNET=LOW:HIGH such as Q2=0:10"
ANCHOR = "first-principles=2%, determinant, or a setting such as Q2=0"


def _pair(text: str, option: str, separator: str, expected: str) -> tuple[str, float, float]:
    """Split NAME=A<separator>B into its name and two numbers."""
    name, equals, rest = text.partition("=")
    parts = re.split(separator, rest)
    try:
        first, second = (float(part.replace("%", "e-2")) for part in parts)
    except ValueError:
        raise InputError(f"--{option} '{text}'", expected) from None
    if not name.strip() or not equals:
        raise InputError(f"--{option} '{text}'", expected)
    return name.strip(), first, second


def _once(found: dict, name: str, option: str, value: tuple[float, float]) -> None:
    if name in found:
        raise InputError(f"--{option} {name} given twice", "each number once")
    found[name] = value


def priors_of(texts: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Read --prior options.

    Parameters
    ----------
    texts : tuple of str
        ``NAME=MEAN+-SD``, also with ± and with a deviation in per cent of the mean.

    Returns
    -------
    dict of str to (float, float)

    Raises
    ------
    InputError
        If one is not of that form, or a name is given twice.

    Examples
    --------
    >>> priors_of(("Q2.slope=167.23+-3.3446", "Q2.intercept=43.17±10%"))
    {'Q2.slope': (167.23, 3.3446), 'Q2.intercept': (43.17, 4.317)}
    """
    found: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, mean, sd = _pair(text, "prior", r"\+-|\+/-|±", PRIOR)
        _once(found, name, "prior", (mean, sd * abs(mean) if text.strip().endswith("%") else sd))
    return found


def bounds_of(texts: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Read --bounds options, ``NAME=LOWER:UPPER``.

    Raises
    ------
    InputError
        If one is not of that form, or a name is given twice.

    Examples
    --------
    >>> bounds_of(("Q2.slope=147.23:187.23",))
    {'Q2.slope': (147.23, 187.23)}
    """
    found: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, low, high = _pair(text, "bounds", ":", BOUNDS)
        _once(found, name, "bounds", (low, high))
    return found


def limits_of(texts: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Read --vary options, ``MAGNET=LOW:HIGH``.

    Raises
    ------
    InputError
        If there is none, one is not of that form, or a magnet is given twice.

    Examples
    --------
    >>> limits_of(("Q2=0:10",))
    {'Q2': (0.0, 10.0)}
    """
    if not texts:
        raise InputError("no --vary", VARY)
    found: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, low, high = _pair(text, "vary", ":", VARY)
        _once(found, name, "vary", (low, high))
    return found


def anchor_of(texts: tuple[str, ...]) -> Anchor:
    """Read --anchor options.

    Parameters
    ----------
    texts : tuple of str
        ``first-principles=2%``, ``determinant``, or settings such as ``Q2=0`` or ``Q1=1,Q2=0``.

    Returns
    -------
    Anchor

    Raises
    ------
    InputError
        If one is not of these forms.

    Examples
    --------
    >>> anchor_of(("first-principles=2%", "Q2=0")).words
    'first principles to 2 % and first principles at Q2 = 0 to 0.1 %'
    """
    deviation, places, determinant = None, [], False
    for text in texts:
        if text == "determinant":
            determinant = True
            continue
        try:
            parts = dict(part.split("=") for part in text.split(","))
            values = {name.strip(): float(v.replace("%", "e-2")) for name, v in parts.items()}
        except ValueError:
            raise InputError(f"--anchor '{text}'", ANCHOR) from None
        if "first-principles" in values:
            if len(values) > 1 or deviation is not None:
                raise InputError(f"--anchor '{text}'", ANCHOR)
            deviation = values["first-principles"]
        else:
            places.append(values)
    return Anchor(deviation=deviation, at=tuple(places), determinant=determinant)
