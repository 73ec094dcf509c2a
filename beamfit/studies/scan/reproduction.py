"""The report's Table 2 and what stands behind its figures 19 to 25, on a SIMULATED scan.

The 14 measured points of the report were never published. Everything here is computed from a scan
simulated with Table 2's first beam matrix; what can be compared with the report is which numbers a
scan of 14 points determines at all.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from beamfit.greybox.fit import Fit
from beamfit.greybox.solve import solve
from beamfit.optics.beam import BeamMatrix
from beamfit.optics.beamline import Beamline
from beamfit.studies.scan.assumptions import Assumptions
from beamfit.studies.scan.calibration import with_numbers
from beamfit.studies.scan.fit import EmittanceFit, fit_emittance
from beamfit.studies.scan.known import see
from beamfit.studies.scan.model import UNIT
from beamfit.studies.scan.scans import QuadScan
from beamfit.studies.scan.transport_network import SCENARIO

__all__ = ["TABLE_2", "Held", "Reproduction", "Steep", "reproduce"]

# Table 2 of the report: σ11, σ12, σ22 in 1e-8 SI, and the objective.
TABLE_2 = {
    "known": ((2.62035, 1.55237, 1.40828), 98.272985503),
    "transport-network": ((2.699999, 1.4, 1.6), 8.5382085177),
    "calibration": ((3.484610, 1.857201, 1.473184), 98.027962242),
}
# Appendix C's bounds; the published slope and intercept are two of them.
BOUNDS = {"Q2.slope": (147.23, 187.23), "Q2.intercept": (23.17, 63.17)}
SLOPES = (147.23, 157.23, 167.23, 177.23, 187.23)
# Beam matrices to hold while the network is trained: the report's two, and one of half the size.
BEAMS = {
    "σ of Table 2, row 1": TABLE_2["known"][0],
    "σ of Table 2, row 2": TABLE_2["transport-network"][0],
    "row 1 with half the emittance": (1.310175, 0.776185, 0.70414),
    "row 1 with twice the emittance": (5.2407, 3.10474, 2.81656),
}


class Held(NamedTuple):
    """A network trained with the beam matrix held: χ², and A and B on a fine grid of currents."""

    words: str
    sigma: tuple[float, float, float]
    emittance: float
    chi2: float
    fit: Fit


class Steep(NamedTuple):
    """The fit with known transport for another slope."""

    slope: float
    chi2: float
    emittance: float


class Reproduction(NamedTuple):
    """Everything the page shows.

    Attributes
    ----------
    known, network, calibration : EmittanceFit
        The three rows of Table 2.
    prior : EmittanceFit
        The calibration with a prior of 2 % on the slope.
    held : tuple of Held
        Networks for beams that are held.
    steep : tuple of Steep
        Beams for slopes that are held.
    line : Beamline
        First principles.
    """

    known: EmittanceFit
    network: EmittanceFit
    calibration: EmittanceFit
    prior: EmittanceFit
    held: tuple[Held, ...]
    steep: tuple[Steep, ...]
    line: Beamline


def reproduce(scan: QuadScan, line: Beamline, starts: int = 20) -> Reproduction:
    """Do what the report's section 3.3.2 did, and what it would have needed to know.

    Parameters
    ----------
    scan : QuadScan
        A scan of Q2 on the Gun Test Facility line.
    line : Beamline
        That line.
    starts : int
        Starts of each network's training.

    Returns
    -------
    Reproduction
    """
    free = {"scenario": "calibration", "bounds": BOUNDS}
    return Reproduction(
        known=fit_emittance(scan, line),
        network=fit_emittance(scan, line, scenario="transport-network", starts=starts),
        calibration=fit_emittance(scan, line, **free),
        prior=fit_emittance(scan, line, priors={"Q2.slope": (167.23, 3.3446)}, **free),
        held=tuple(_held(scan, line, words, sigma, starts) for words, sigma in BEAMS.items()),
        steep=tuple(_steep(scan, line, slope) for slope in SLOPES),
        line=line,
    )


def _held(scan: QuadScan, line: Beamline, words: str, sigma, starts: int) -> Held:
    """Train the network of A and B for a beam that is held."""
    told = Assumptions(starts=starts)
    problem = SCENARIO.state(see(scan, line, ("x",)), told)
    beam = BeamMatrix.from_sigma(*(1e-8 / UNIT**2 * s for s in sigma))
    numbers = {k: float(getattr(beam, k)) for k in ("l11", "l21", "l22")}
    model = problem.model | {"beam": {"x": numbers}}
    weights = [f for f in problem.free if not f.path.startswith("beam.")]
    fit = solve(replace(problem, model=model, free=weights), starts)
    emittance = 1e-8 * float(np.sqrt(sigma[0] * sigma[2] - sigma[1] ** 2))
    return Held(words, sigma, emittance, fit.chi2, fit)


def _steep(scan: QuadScan, line: Beamline, slope: float) -> Steep:
    fit = fit_emittance(scan, with_numbers(line, {"Q2.slope": slope}))
    return Steep(slope, fit.x.chi2, fit.x.emittance.value)
