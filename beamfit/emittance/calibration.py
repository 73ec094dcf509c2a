"""Calibration scenario: calibration parameters of magnets are free, within priors and bounds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import jax

from beamfit.emittance.assumptions import Assumptions
from beamfit.emittance.results import Parameter
from beamfit.emittance.statement import PreparedScan, Scenario, beam_problem, varied_magnets
from beamfit.errors import InputError, Status, nearest
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import Free, Prior, Problem
from beamfit.greybox.tree import leaves
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import CurrentPolynomial, SlopeIntercept

# Relative half width of the bounds of a slope: the report has 167.23 ± 20 for the slope, and
# 43.17 ± 20 for the intercept (appendix C).
RELATIVE_BOUND = 20.0 / 167.23


class NumberKind(Enum):
    """Effect of a calibration parameter on k1: it scales, shifts or bends its curve."""

    slope = "slope"
    offset = "offset"
    bend = "bend"


# Kind and unit of the parameters of a calibration, in the order of its fields; the last one also
# holds for further parameters.
_NUMBER_KINDS = {
    SlopeIntercept: ((NumberKind.slope, "MeV/(m^2 A)"), (NumberKind.offset, "MeV/m^2")),
    CurrentPolynomial: (
        (NumberKind.offset, "T/m"),
        (NumberKind.slope, "T/(m A)"),
        (NumberKind.bend, "1"),
    ),
}


class Number(NamedTuple):
    """A parameter of a magnet's calibration, with its value in the lattice.

    Attributes
    ----------
    magnet, path : str
        Name of the magnet, and path within its calibration.
    value : float
        In ``unit``.
    kind : NumberKind
        Effect on k1.
    reach : float
        Half width of its default bounds.
    unit : str
        Unit of the value.
    """

    magnet: str
    path: str
    value: float
    kind: NumberKind
    reach: float
    unit: str

    @property
    def name(self) -> str:
        """Name for users."""
        return f"{self.magnet}.{self.path}"


def numbers_of_magnets(line: Beamline, magnets: tuple[str, ...] | None = None) -> dict[str, Number]:
    """Calibration parameters of magnets, by name.

    Parameters
    ----------
    line : Beamline
        The line.
    magnets : tuple of str, optional
        Magnets of interest; all of the line if None.

    Returns
    -------
    dict of str to Number
        Default bounds in proportion to the report's: 12 % of the slope; for the offset 12 % of the
        strength that one ampere gives; for any other parameter 12 % of its value.

    Examples
    --------
    >>> from beamfit.optics.elements import Quadrupole
    >>> magnet = Quadrupole("Q2", 0.1, 0.0, SlopeIntercept(167.23, 43.17))
    >>> found = numbers_of_magnets(Beamline((magnet,), energy=100.0))
    >>> [(name, n.value, round(n.reach, 2)) for name, n in found.items()]
    [('Q2.slope', 167.23, 20.0), ('Q2.intercept', 43.17, 20.0)]
    """
    found = {}
    for magnet in line.magnets if magnets is None else magnets:
        if len(line.members(magnet)) > 1:  # each member has parameters of its own
            if magnets is None:
                continue
            found_text = f"a calibration of '{magnet}', which feeds several magnets"
            raise InputError(
                found_text, "scenario known, or a scan of magnets on supplies of their own"
            )
        calibration = line[magnet].calibration
        meanings = _NUMBER_KINDS.get(type(calibration), ((NumberKind.slope, "1"),))
        values = [float(v) for v in jax.tree_util.tree_leaves(calibration)]
        number_kinds = [meanings[min(i, len(meanings) - 1)] for i in range(len(values))]
        slopes = [
            v for v, (kind, _) in zip(values, number_kinds, strict=True) if kind is NumberKind.slope
        ]
        for leaf, value, (kind, unit) in zip(
            leaves(calibration), values, number_kinds, strict=True
        ):
            reach = (
                RELATIVE_BOUND * abs(value) + 1e-3
                if kind is NumberKind.bend
                else RELATIVE_BOUND * abs(slopes[0])
            )
            number = Number(magnet, leaf.path, value, kind, reach, unit)
            found[number.name] = number
    return found


def with_numbers(line: Beamline, numbers: Mapping[str, float]) -> Beamline:
    """Set calibration parameters of a line.

    Parameters
    ----------
    line : Beamline
        The line.
    numbers : mapping of str to float
        Such as ``{"Q2.slope": 160.0}``.

    Returns
    -------
    Beamline

    Raises
    ------
    InputError
        If the line has no such parameter.

    Examples
    --------
    >>> from beamfit.optics.elements import Quadrupole
    >>> line = Beamline((Quadrupole("Q", 0.1),), energy=100.0)
    >>> float(with_numbers(line, {"Q.scale": 1.1})["Q"].calibration.scale)
    1.1
    """
    numbers_of_line = numbers_of_magnets(line)
    for name in numbers:
        if name not in numbers_of_line:
            raise InputError(f"a calibration number '{name}'", nearest(name, list(numbers_of_line)))
    for magnet in dict.fromkeys(numbers_of_line[name].magnet for name in numbers):
        old = line[line.members(magnet)[0]]
        structure = jax.tree_util.tree_structure(old.calibration)
        values = [numbers.get(n, v.value) for n, v in numbers_of_line.items() if v.magnet == magnet]
        new = jax.tree_util.tree_unflatten(structure, values)
        line = line.with_element(replace(old, calibration=new))
    return line


def _free_numbers(prepared: PreparedScan, assumptions: Assumptions) -> dict[str, Number]:
    """Slope and offset of the scanned magnets, and all parameters with priors or bounds."""
    all_numbers, varied = numbers_of_magnets(prepared.scanned), varied_magnets(prepared.scan)
    given = [*assumptions.calibrations, *assumptions.bounds]
    for name in given:
        if name not in all_numbers:
            raise InputError(f"a prior or bounds on '{name}'", nearest(name, list(all_numbers)))
    return {
        name: number
        for name, number in all_numbers.items()
        if name in given or (number.magnet in varied and number.kind is not NumberKind.bend)
    }


def _state(prepared: PreparedScan, assumptions: Assumptions) -> Problem:
    """Problem with free beams and calibrations, for all planes together."""
    numbers = _free_numbers(prepared, assumptions)
    magnets = {n.magnet: prepared.scanned[n.magnet].calibration for n in numbers.values()}
    free, priors = [], []
    for name, number in numbers.items():
        low, high = number.value - number.reach, number.value + number.reach
        if name in assumptions.priors:
            mean, sd = assumptions.priors[name]
            low, high = min(low, mean - 6 * sd), max(high, mean + 6 * sd)
            priors.append(Prior(f"magnets.{name}", mean, sd))
        free.append(Free(f"magnets.{name}", *assumptions.bounds.get(name, (low, high))))
    prepared = prepared.with_variable(magnets)
    return beam_problem(prepared, model={"magnets": magnets}, free=free, priors=priors)


def _parameters(prepared: PreparedScan, assumptions: Assumptions, fit: Fit) -> Iterator[Parameter]:
    """Fitted calibration parameters."""
    settled = fit.status is not Status.not_converged
    for name, number in _free_numbers(prepared, assumptions).items():
        v, prior = fit[f"magnets.{name}"], assumptions.priors.get(name)
        yield Parameter.of(name, v, number.unit, prior, settled)


def _null_directions(
    prepared: PreparedScan, parameters: tuple[Parameter, ...], identified: bool
) -> tuple[str, ...]:
    """Sentences on calibration parameters that the sizes do not determine."""
    known, sentences = numbers_of_magnets(prepared.scanned), []
    for parameter in parameters:
        if parameter.status is Status.converged:
            continue
        if known[parameter.name].kind is NumberKind.offset:
            sentences.append(
                f"{parameter.name}: a shift of k1 is undone by a lens at that magnet in the beam, "
                "so beta and alpha change and the emittance does not (exact for a thin lens)"
            )
        elif not identified:
            sentences.append(
                f"{parameter.name}: a steeper calibration with a beam of smaller emittance gives "
                "the same sizes (emittance as 1/slope)"
            )
    if not identified and not sentences:
        sentences.append("the calibration and the beam together: no single number is to blame")
    return tuple(sentences)


def _remedy(prepared: PreparedScan, assumptions: Assumptions) -> str:
    """Measurements or priors that would determine the emittance, in words."""
    known = numbers_of_magnets(prepared.scanned, varied_magnets(prepared.scan))
    slopes = [name for name, number in known.items() if number.kind is NumberKind.slope]
    without_prior = [name for name in slopes if name not in assumptions.priors]
    second = "a second screen (see beamfit design)"
    if without_prior:
        return f"a prior on {without_prior[0]}, or {second}"
    tighter = f", or a tighter prior on {slopes[0]} than the one given" if slopes else ""
    return f"{second}, more settings{tighter}"


SCENARIO = Scenario(
    "calibration",
    _state,
    _parameters,
    _null_directions,
    _remedy,
    consequence="; the emittance is not affected",
)
