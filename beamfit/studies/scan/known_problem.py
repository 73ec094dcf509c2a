"""The fit with known transport as a grey-box problem, for those who want more than its optimum."""

from __future__ import annotations

from beamfit.greybox.problem import Problem
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.scenario_data import beam_free, beam_numbers, plane_rows, see, size_record

__all__ = ["known_problem"]


def known_problem(fit: EmittanceFit) -> Problem:
    """State the known-transport fit of all its planes, starting from its answer.

    Parameters
    ----------
    fit : EmittanceFit
        A fit of scenario "known".

    Returns
    -------
    Problem
        Of the same residuals; where the scan has no errors, with those the fit inferred.

    Examples
    --------
    >>> from beamfit.optics.beamline import Beamline
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> from beamfit.studies.scan.emittance import fit_emittance
    >>> from beamfit.studies.scan.scans import QuadScan
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
    >>> sizes = [3.4e-4, 1.9e-4, 0.9e-4, 1.9e-4, 3.4e-4]
    >>> scan = QuadScan({"Q": [-1.0, 1.5, 4.0, 6.5, 9.0]}, {"Q": "k1"}, {"x": sizes})
    >>> known_problem(fit_emittance(scan, line)).names
    ('beam.x.l11', 'beam.x.l21', 'beam.x.l22')
    """
    seen = see(fit.scan, fit.line, tuple(p.plane for p in fit.planes), fit.planes[0].method)
    beams = beam_numbers(seen)
    records = [size_record(seen, plane, plane_rows(seen, plane)) for plane in seen.planes]
    return Problem({"beam": beams}, beam_free(beams), records)
