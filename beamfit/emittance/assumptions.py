"""Assumptions of a scenario: priors, bounds, anchors. Plain values, no JAX."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral, Real
from typing import NamedTuple

from beamfit.answer import shown
from beamfit.errors import InputError, expect, nearest


class Entry(NamedTuple):
    """A scenario's module and options, known without loading JAX.

    ``map_free`` marks a network of R11 and R12. Such a map takes a determinant, gains and a box,
    but no priors on beam and line.
    """

    module: str
    numbers: bool = False
    anchor: bool = False
    branches: bool = False
    map_free: bool = False


# A new scenario is a module with a `SCENARIO` and a line here.
SCENARIOS = {
    "known": Entry("statement"),
    "transport-network": Entry("transport_network", anchor=True, map_free=True),
    "calibration": Entry("calibration", numbers=True),
    "focusing-network": Entry("focusing_network", anchor=True, branches=True),
}


# Parameters of screen, beam and elements with priors, in every scenario. A network of R11 and R12
# takes those of the screen only.
SCREEN_PRIORS, BEAM_PRIORS = ("size_scale", "wire"), ("resolution", "energy")
BEAM_PRIORS += ("dispersion", "dispersion_slope")
ELEMENT_PRIORS = (".gradient", ".length")


def is_systematic(name: str) -> bool:
    """Distinguish priors on screen, beam or line from priors on a calibration.

    Examples
    --------
    >>> is_systematic("size_scale"), is_systematic("D1.length"), is_systematic("Q2.slope")
    (True, True, False)
    """
    return name in (*SCREEN_PRIORS, *BEAM_PRIORS) or name.endswith(ELEMENT_PRIORS)


def _scenarios_with(field_name: str) -> str:
    """Names of the scenarios with an option."""
    return " or ".join(name for name, entry in SCENARIOS.items() if getattr(entry, field_name))


@shown
@dataclass(frozen=True)
class Anchor:
    """A tie of a network to first principles; without it a scan cannot separate scale and beam.

    Parameters
    ----------
    deviation : float, optional
        Relative standard deviation of the network from first principles: of R11 and R12 in units
        of their rms over the scan (transport-network), of k1 at the largest current
        (focusing-network). It applies twice: independently at each measured setting, and once to
        all of them in common, like a wrong energy, which does not average out.
    at : tuple of mapping, optional
        Settings, magnet name to value, at which first principles hold.
    sd : float
        Relative standard deviation there.
    determinant : bool
        Require det T = 1 at every setting, with C and D two further free functions of the
        network (transport-network).

    Raises
    ------
    InputError
        If a deviation is not positive.

    Examples
    --------
    >>> Anchor(deviation=0.02).words
    'first principles to 2 %'
    """

    deviation: float | None = None
    at: tuple[Mapping[str, float], ...] = ()
    sd: float = 1e-3
    determinant: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.at, Mapping):
            raise InputError("an anchor at one mapping", "a tuple of them: at=({'Q2': 0.0},)")
        for name in ("deviation", "sd"):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, Real) and math.inf > value > 0):
                raise InputError(f"anchor {name} {value}", "a positive relative deviation")

    @property
    def words(self) -> str:
        """The anchor in words; "none" without a tie."""
        parts = []
        if self.deviation is not None:
            parts.append(f"first principles to {100 * self.deviation:.3g} %")
        for place in self.at:
            where = ", ".join(f"{n} = {v:g}" for n, v in place.items())
            parts.append(f"first principles at {where} to {100 * self.sd:.3g} %")
        if self.determinant:
            parts.append("det T = 1 with C and D free")
        return " and ".join(parts) or "none"


@dataclass(frozen=True)
class Assumptions:
    """Assumptions of a scenario besides scan and line.

    Parameters
    ----------
    priors : mapping of str to (float, float), optional
        Calibration parameter, such as ``Q2.slope``, or parameter of screen, beam and line, such as
        ``size_scale`` (see `beamfit.emittance.systematics.with_systematics`), to mean and standard
        deviation. A mean of None is the line's value.
    bounds : mapping of str to (float, float), optional
        The same to a lower and an upper bound. For a transport network the box of the beam
        (``x.sigma11`` in m² and so on) and that of its inputs (``Q2``).
    gains : mapping of str to (float, float), optional
        Gain of a transport network, such as ``dA_x/dQ2`` per unit of the setting, to lower and
        upper limit, one of which may be infinite. The network is then the report's: only these
        gains are limited, everywhere in the box of the inputs.
    anchor : Anchor, optional
        Tie of a network to first principles.
        For the networks.
    hysteresis : bool
        Whether k1 of a focusing network may differ between rising and falling current.
    hidden : int
        Hidden nodes of a network.
    starts, seed : int
        Starts of a network's training, and the seed of their random numbers.

    Raises
    ------
    InputError
        If a prior's standard deviation is not positive, bounds are reversed or not finite, or a
        count is below one.

    Examples
    --------
    >>> Assumptions(priors={"Q2.slope": (167.23, 3.3446)}).priors["Q2.slope"]
    (167.23, 3.3446)
    """

    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    gains: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    anchor: Anchor = field(default_factory=Anchor)
    hysteresis: bool = False
    hidden: int = 5
    starts: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        self._check_types()
        for name, (mean, sd) in self.priors.items():
            if not (math.isfinite(mean or 0.0) and math.isfinite(sd) and sd > 0):
                expected = "a finite mean and a positive deviation"
                raise InputError(f"prior {name} = {mean}+-{sd:g}", expected)
        for name, (low, high) in self.bounds.items():
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise InputError(f"bounds {name} = {low:g}:{high:g}", "finite bounds, lower first")
            mean = self.priors.get(name, (low, 0.0))[0]
            if not low <= mean <= high:
                raise InputError(
                    f"prior mean {mean:g} of {name} outside its bounds {low:g}:{high:g}",
                    "a mean within the bounds",
                )
        for name, (low, high) in self.gains.items():
            if not low < high or (math.isinf(low) and math.isinf(high)):
                expected = "a finite limit at least, lower first"
                raise InputError(f"gain {name} = {low:g}:{high:g}", expected)
        for name, minimum in (("hidden", 1), ("starts", 1), ("seed", 0)):
            value = getattr(self, name)
            if not (isinstance(value, Integral) and value >= minimum):
                raise InputError(f"{name} {value!r}", f"an integer of at least {minimum}")

    def _check_types(self) -> None:
        """Raise an error for values of a wrong type."""
        expect(self.anchor, Anchor, "beamfit.Anchor(determinant=True)")
        for kind in ("priors", "bounds", "gains"):
            expect(getattr(self, kind), Mapping, f"{kind}={{'Q2.slope': (160.0, 170.0)}}")
            for name, pair in getattr(self, kind).items():
                numbers = isinstance(pair, Sequence) and len(pair) == 2
                if not (numbers and all(v is None or isinstance(v, Real) for v in pair)):
                    raise InputError(f"{kind} {name} = {pair!r}", "a pair of numbers")

    @property
    def systematics(self) -> dict[str, tuple[float | None, float]]:
        """Priors on screen, beam and line."""
        return {name: prior for name, prior in self.priors.items() if is_systematic(name)}

    @property
    def calibrations(self) -> dict[str, tuple[float, float]]:
        """Priors on calibrations."""
        return {name: prior for name, prior in self.priors.items() if not is_systematic(name)}

    def check_scenario(self, scenario: str) -> None:
        """Raise an error for an unknown scenario, or for assumptions that it does not take.

        Raises
        ------
        InputError
            If the scenario is unknown, or priors, bounds, an anchor or branches do not apply.
        """
        if scenario not in SCENARIOS:
            raise InputError(f"scenario '{scenario}'", nearest(str(scenario), list(SCENARIOS)))
        entry = SCENARIOS[scenario]
        calibration_names = [*self.calibrations, *self.bounds]
        not_on_screen = [name for name in self.systematics if name not in SCREEN_PRIORS]
        if not_on_screen and entry.map_free:
            expected = f"{' or '.join(SCREEN_PRIORS)}: R11 and R12 are free in it already"
            raise InputError(f"a prior on {not_on_screen[0]} with scenario {scenario}", expected)
        takes = entry.numbers or (entry.map_free and not self.calibrations)
        if calibration_names and not takes:
            raise InputError(
                f"a prior or bounds on {calibration_names[0]} with scenario {scenario}",
                f"scenario {_scenarios_with('numbers')}, whose calibration numbers are free",
            )
        checks = (
            ("an anchor", self.anchor != Anchor(), "anchor"),
            ("anchor determinant", self.anchor.determinant, "map_free"),
            ("hysteresis", self.hysteresis, "branches"),
            ("limits of gains", self.gains, "map_free"),
        )
        for words, given, field_name in checks:
            if given and not getattr(entry, field_name):
                raise InputError(f"{words} with scenario {scenario}", _scenarios_with(field_name))
