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
    """A scenario as it is known before JAX is loaded: the module that has it, what it takes.

    ``map_free`` is that of a network of R11 and R12: such a map can be asked for a determinant,
    gains and a box, and has no use for priors on beam and line.
    """

    module: str
    numbers: bool = False
    anchor: bool = False
    branches: bool = False
    map_free: bool = False


# A further scenario is a module with a `SCENARIO` and a line here.
SCENARIOS = {
    "known": Entry("statement"),
    "transport-network": Entry("transport_network", anchor=True, map_free=True),
    "calibration": Entry("calibration", numbers=True),
    "focusing-network": Entry("focusing_network", anchor=True, branches=True),
}


# Numbers of the screen, of the beam and of elements that every scenario can free, with priors. A
# network of R11 and R12 has those of the screen alone.
ON_SCREEN, OF_BEAM = ("size_scale", "wire"), ("resolution", "energy")
OF_BEAM += ("dispersion", "dispersion_slope")
OF_ELEMENTS = (".gradient", ".length")


def is_systematic(name: str) -> bool:
    """Tell a prior on screen, beam or line from one on a calibration.

    Examples
    --------
    >>> is_systematic("size_scale"), is_systematic("D1.length"), is_systematic("Q2.slope")
    (True, True, False)
    """
    return name in (*ON_SCREEN, *OF_BEAM) or name.endswith(OF_ELEMENTS)


def _taking(what: str) -> str:
    """The scenarios that take something."""
    return " or ".join(name for name, entry in SCENARIOS.items() if getattr(entry, what))


@shown
@dataclass(frozen=True)
class Anchor:
    """A tie of a network to first principles; without it a scan cannot tell scale from beam.

    Parameters
    ----------
    deviation : float, optional
        Relative standard deviation of the network from first principles: of R11 and R12 in units
        of their rms over the scan (transport-network), of k1 at the largest current
        (focusing-network). It counts twice, independent at each measured setting and once in
        common at all of them, as a wrong energy would: that does not average out.
    at : tuple of mapping, optional
        Settings, magnet name to value, at which first principles hold.
    sd : float
        Relative standard deviation there.
    determinant : bool
        Ask for det T = 1 at every setting, with C and D two further free functions of the
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
        """The anchor in words; "none" if nothing is tied."""
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
    """Everything a scenario is told besides scan and line.

    Parameters
    ----------
    priors : mapping of str to (float, float), optional
        Calibration number, such as ``Q2.slope``, or number of screen, beam and line, such as
        ``size_scale`` (see `beamfit.emittance.systematics.with_systematics`), to mean and
        standard deviation. A mean of None is that of the line.
    bounds : mapping of str to (float, float), optional
        The same to a lower and an upper bound. Of a transport network the box of the beam
        (``x.sigma11`` in m² and so on) and that of its inputs (``Q2``).
    gains : mapping of str to (float, float), optional
        Gain of a transport network, such as ``dA_x/dQ2`` per unit of the setting, to lower and
        upper limit, one of which may be infinite. The network is then the report's: its gains are
        free but for these, which hold everywhere in the box of the inputs.
    anchor : Anchor, optional
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
        for name, least in (("hidden", 1), ("starts", 1), ("seed", 0)):
            value = getattr(self, name)
            if not (isinstance(value, Integral) and value >= least):
                raise InputError(f"{name} {value!r}", f"an integer of at least {least}")

    def _check_types(self) -> None:
        expect(self.anchor, Anchor, "beamfit.Anchor(determinant=True)")
        for kind in ("priors", "bounds", "gains"):
            expect(getattr(self, kind), Mapping, f"{kind}={{'Q2.slope': (160.0, 170.0)}}")
            for name, pair in getattr(self, kind).items():
                numbers = isinstance(pair, Sequence) and len(pair) == 2
                if not (numbers and all(v is None or isinstance(v, Real) for v in pair)):
                    raise InputError(f"{kind} {name} = {pair!r}", "a pair of numbers")

    @property
    def systematics(self) -> dict[str, tuple[float | None, float]]:
        """The priors on screen, beam and line."""
        return {name: prior for name, prior in self.priors.items() if is_systematic(name)}

    @property
    def calibrations(self) -> dict[str, tuple[float, float]]:
        """The priors on calibrations."""
        return {name: prior for name, prior in self.priors.items() if not is_systematic(name)}

    def check_scenario(self, scenario: str) -> None:
        """Refuse an unknown scenario, and what a scenario has no use for.

        Raises
        ------
        InputError
            If the scenario is unknown, or priors, bounds, an anchor or branches do not apply.
        """
        if scenario not in SCENARIOS:
            raise InputError(f"scenario '{scenario}'", nearest(str(scenario), list(SCENARIOS)))
        entry = SCENARIOS[scenario]
        named = [*self.calibrations, *self.bounds]
        beyond = [name for name in self.systematics if name not in ON_SCREEN]
        if beyond and entry.map_free:
            expected = f"{' or '.join(ON_SCREEN)}: R11 and R12 are free in it already"
            raise InputError(f"a prior on {beyond[0]} with scenario {scenario}", expected)
        takes = entry.numbers or (entry.map_free and not self.calibrations)
        if named and not takes:
            raise InputError(
                f"a prior or bounds on {named[0]} with scenario {scenario}",
                f"scenario {_taking('numbers')}, whose calibration numbers are free",
            )
        refused = (
            ("an anchor", self.anchor != Anchor(), "anchor"),
            ("anchor determinant", self.anchor.determinant, "map_free"),
            ("hysteresis", self.hysteresis, "branches"),
            ("limits of gains", self.gains, "map_free"),
        )
        for words, asked, what in refused:
            if asked and not getattr(entry, what):
                raise InputError(f"{words} with scenario {scenario}", _taking(what))
