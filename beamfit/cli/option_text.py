"""Parsing of option texts: priors, bounds, limits, anchors and targets; without JAX.

Messages name the option of the command line.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any

from beamfit.emittance.assumptions import Anchor
from beamfit.emittance.targets import Target
from beamfit.errors import InputError

PRIOR = "NAME=MEAN+-SD such as Q2.slope=167.23+-3.3446"
BOUNDS = "NAME=LOWER:UPPER such as Q2.slope=147.23:187.23"
GAINS = "NAME=LOWER:UPPER, one of them may be left out, such as dA_x/dQ2=:-0.0083"
VARY = "NAME=LOW:HIGH such as Q2=0:10"
ANCHOR = "first-principles=2%, determinant, or a setting such as Q2=0"
TARGET = "size=200um, divergence=140urad (with _x or _y), match, or match=BETA_M:ALPHA"
UNITS = {
    "size": {"nm": 1e-9, "um": 1e-6, "µm": 1e-6, "mm": 1e-3, "m": 1.0},
    "divergence": {"nrad": 1e-9, "urad": 1e-6, "µrad": 1e-6, "mrad": 1e-3, "rad": 1.0},
}
# Largest relative deviation of a network from first principles; a larger number lacks a per cent
# sign.
MAX_DEVIATION = 0.5


def _fraction(text: str) -> float:
    """Read a relative number, also in per cent."""
    text = text.strip()
    return float(text[:-1]) / 100.0 if text.endswith("%") else float(text)


def _deviation(text: str, mean: float) -> float:
    """Read a standard deviation, also in per cent of the mean."""
    return _fraction(text) * (abs(mean) if "%" in text else 1.0)


def named_of(
    texts: Iterable[str], option: str, form: str, read: Callable[[str], Any] = str
) -> dict[str, Any]:
    """Read NAME=VALUE, each name once.

    Examples
    --------
    >>> named_of(["valve=0.2"], "rate", "INPUT=PER_SECOND", float)
    {'valve': 0.2}
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, _, rest = (part.strip() for part in text.partition("="))
        try:
            value = read(rest)
        except ValueError:
            raise InputError(f"--{option} '{text}'", form) from None
        if not (name and rest):
            raise InputError(f"--{option} '{text}'", form)
        if name in found:
            raise InputError(f"--{option} {name} given twice", "each name once")
        found[name] = value
    return found


def _pairs(
    texts: Iterable[str],
    option: str,
    separator: str,
    form: str,
    second: Callable[[str, float], float] = lambda text, first: float(text),
) -> dict[str, tuple[float, float]]:
    """Read NAME=A<separator>B, each name once."""

    def pair(text: str) -> tuple[float, float]:
        left, right = re.split(separator, text)
        return float(left), second(right, float(left))

    return named_of(texts, option, form, pair)


def priors_of(texts: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Read priors of parameters.

    Parameters
    ----------
    texts : iterable of str
        ``NAME=MEAN+-SD``, also with ± and with a deviation in per cent of the mean.

    Returns
    -------
    dict of str to (float, float)
        Mean and standard deviation by name, as `fit_emittance` takes them for ``priors``.

    Raises
    ------
    InputError
        If one is not of that form, or a name is given twice.

    Examples
    --------
    >>> priors_of(["Q2.slope=167.23+-3.3446", "Q2.intercept=43.17±10%"])
    {'Q2.slope': (167.23, 3.3446), 'Q2.intercept': (43.17, 4.317)}
    """
    return _pairs(texts, "prior", r"\+-|\+/-|±", PRIOR, _deviation)


def bounds_of(texts: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Read bounds of parameters, ``NAME=LOWER:UPPER``.

    Raises
    ------
    InputError
        If one is not of that form, or a name is given twice.

    Examples
    --------
    >>> bounds_of(["Q2.slope=147.23:187.23"])
    {'Q2.slope': (147.23, 187.23)}
    """
    return _pairs(texts, "bounds", ":", BOUNDS)


def gains_of(
    texts: Iterable[str], option: str = "gain", form: str = GAINS
) -> dict[str, tuple[float, float]]:
    """Read limits ``NAME=LOWER:UPPER`` of an option; a missing end is infinite.

    Raises
    ------
    InputError
        If one is not of that form, or a name is given twice.

    Examples
    --------
    >>> gains_of(["dA_x/dQ2=:-0.0083", "dB_x/dQ2=-1:0"])
    {'dA_x/dQ2': (-inf, -0.0083), 'dB_x/dQ2': (-1.0, 0.0)}
    """
    whole = [re.sub(r"=\s*:", "=-inf:", re.sub(r":\s*$", ":inf", text)) for text in texts]
    return _pairs(whole, option, ":", form)


def limits_of(texts: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Read the limits of magnets, ``NAME=LOW:HIGH``.

    Raises
    ------
    InputError
        If one is not of that form, or a magnet is given twice.

    Examples
    --------
    >>> limits_of(["Q2=0:10"])
    {'Q2': (0.0, 10.0)}
    """
    return _pairs(texts, "vary", ":", VARY)


def anchor_of(texts: Iterable[str]) -> Anchor:
    """Read the anchors of a network to first principles.

    Parameters
    ----------
    texts : iterable of str
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
    >>> anchor_of(["first-principles=2%", "Q2=0"]).words
    'first principles to 2 % and first principles at Q2 = 0 to 0.1 %'
    """
    deviation, places, determinant = None, [], False
    for text in texts:
        if text == "determinant":
            determinant = True
            continue
        try:
            named = {n.strip(): v for n, v in (part.split("=") for part in text.split(","))}
            if "first-principles" not in named:
                places.append({name: float(value) for name, value in named.items()})
                continue
            [value] = named.values()
            found = _fraction(value)
        except ValueError:
            raise InputError(f"--anchor '{text}'", ANCHOR) from None
        if deviation is not None:
            raise InputError(f"--anchor '{text}' beside another", "first-principles once")
        if found > MAX_DEVIATION and "%" not in value:
            found_words = f"--anchor '{text}', a deviation of {100 * found:g} %"
            raise InputError(found_words, f"{ANCHOR}; was {value.strip()}% meant?")
        deviation = found
    return Anchor(deviation=deviation, at=tuple(places), determinant=determinant)


def target_of(text: str, plane: str = "x") -> Target:
    """Read a target at the screen.

    Parameters
    ----------
    text : str
        ``size=200um``, ``divergence=140urad``, ``match`` to the design Twiss parameters of the
        lattice, or ``match=BETA_M:ALPHA``; ``size_y`` and so on name the plane.
    plane : str
        Default plane.

    Returns
    -------
    Target
        In SI.

    Raises
    ------
    InputError
        If it is not of these forms.

    Examples
    --------
    >>> target_of("size_y=2mm")
    Target(kind='size', plane='y', value=0.002)
    """
    name, _, rest = text.partition("=")
    kind, _, own_plane = name.strip().partition("_")
    if kind not in (*UNITS, "match") or own_plane not in ("", "x", "y"):
        raise InputError(f"--target '{text}'", TARGET)
    own_plane = own_plane or plane
    if kind == "match":
        try:
            beta, alpha = (float(part) for part in rest.split(":")) if rest else (None, None)
        except ValueError:
            raise InputError(f"--target '{text}'", TARGET) from None
        return Target(kind, own_plane, (beta, alpha) if rest else None)
    # The Greek letter mu and the micro sign look alike.
    parts = re.fullmatch(r"\s*([-+0-9.eE]+)\s*([a-zµ]+)\s*", rest.replace("\u03bc", "\u00b5"))
    try:
        return Target(kind, own_plane, float(parts[1]) * UNITS[kind][parts[2]])
    except (TypeError, ValueError, KeyError):
        expected = f"a number with a unit: {', '.join(UNITS[kind])}"
        raise InputError(f"--target '{text}'", expected) from None


def goal_of(text: str) -> float:
    """Read the relative error at which to stop, in per cent.

    Raises
    ------
    InputError
        If it is not between 0 and 100 %.

    Examples
    --------
    >>> goal_of("0.8%")
    0.008
    """
    try:
        value = float(text.rstrip("% ")) / 100.0
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1.0:
        raise InputError(f"--goal '{text}'", "a relative error in per cent, such as 1%")
    return value


def energies_of(text: str) -> tuple[float, ...]:
    """Read energies in MeV separated by commas.

    Raises
    ------
    InputError
        If one is no number.

    Examples
    --------
    >>> energies_of("25,35")
    (25.0, 35.0)
    """
    try:
        return tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise InputError(f"--energies '{text}'", "numbers in MeV, such as 25,35") from None
