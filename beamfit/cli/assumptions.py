"""Priors, bounds and anchors as they are typed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

from beamfit.errors import InputError, nearest
from beamfit.studies.scan.assumptions import Anchor

if TYPE_CHECKING:
    from beamfit.io.lattice import LatticeFile

__all__ = ["anchor_of", "bounds_of", "check_magnets", "limits_of", "priors_of"]

PRIOR = "NAME=MEAN+-SD such as Q2.slope=167.23+-3.3446"
BOUNDS = "NAME=LOWER:UPPER such as Q2.slope=147.23:187.23"
VARY = "MAGNET=LOW:HIGH such as Q2=0:10"
ANCHOR = "first-principles=2%, determinant, or a setting such as Q2=0"


# A network may miss first principles by this; more is a per cent sign left out.
LOOSEST = 0.5


def _fraction(text: str) -> float:
    """Read a relative number, also in per cent."""
    text = text.strip()
    return float(text[:-1]) / 100.0 if text.endswith("%") else float(text)


def _parts(text: str, option: str, separator: str, expected: str) -> tuple[str, str, str]:
    """Split NAME=A<separator>B into its name and two words."""
    name, equals, rest = text.partition("=")
    parts = re.split(separator, rest)
    if not name.strip() or not equals or len(parts) != 2:
        raise InputError(f"--{option} '{text}'", expected)
    return name.strip(), parts[0], parts[1]


def _range(text: str, option: str, expected: str) -> tuple[str, float, float]:
    """Read NAME=LOWER:UPPER."""
    name, low, high = _parts(text, option, ":", expected)
    try:
        return name, float(low), float(high)
    except ValueError:
        raise InputError(f"--{option} '{text}'", expected) from None


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
        name, middle, width = _parts(text, "prior", r"\+-|\+/-|±", PRIOR)
        try:
            mean, sd = float(middle), _fraction(width)
        except ValueError:
            raise InputError(f"--prior '{text}'", PRIOR) from None
        _once(found, name, "prior", (mean, sd * abs(mean) if "%" in width else sd))
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
        name, low, high = _range(text, "bounds", BOUNDS)
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
        name, low, high = _range(text, "vary", VARY)
        _once(found, name, "vary", (low, high))
    return found


def check_magnets(limits: Mapping[str, tuple[float, float]], lattice: LatticeFile) -> None:
    """Refuse limits of a magnet that a lattice file does not have.

    Raises
    ------
    InputError
        Naming the file and the nearest magnet.
    """
    for name in limits:
        if name not in lattice.calibrations:
            known = list(lattice.calibrations)
            raise InputError(
                f"--vary {name}: no magnet '{name}'", nearest(name, known), path=lattice.path
            )


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
            parts = [part.split("=") for part in text.split(",")]
            named = {name.strip(): value for name, value in parts}
            if "first-principles" not in named:
                places.append({name: float(value) for name, value in named.items()})
                continue
            [(_, value)] = named.items()
            found = _fraction(value)
        except ValueError:
            raise InputError(f"--anchor '{text}'", ANCHOR) from None
        if deviation is not None:
            raise InputError(f"--anchor '{text}' beside another", "first-principles once")
        if found > LOOSEST and "%" not in value:
            raise InputError(
                f"--anchor '{text}', a deviation of {100 * found:g} %",
                f"{ANCHOR}; was {value.strip()}% meant?",
            )
        deviation = found
    return Anchor(deviation=deviation, at=tuple(places), determinant=determinant)
