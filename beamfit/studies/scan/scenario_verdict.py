"""Whether a scan would determine the emittance if what a scenario found of the line were true.

Priors and anchors can make a covariance finite where the sizes are noise or too few to judge. So
the scan is fitted once more with the line as the scenario found it, and the verdict of the
known-transport fit is asked.
"""

from __future__ import annotations

from collections.abc import Mapping

from beamfit.studies.scan.plane import work_on
from beamfit.studies.scan.results import Points
from beamfit.studies.scan.scenario_data import Seen
from beamfit.studies.scan.verdict import Verdict, judge

__all__ = ["verdicts_on"]


def verdicts_on(seen: Seen, points: Mapping[str, Points]) -> dict[str, Verdict]:
    """Judge each plane of a scan with the transfer-matrix elements that a scenario found.

    Parameters
    ----------
    seen : Seen
        The scan.
    points : mapping of str to Points
        Plane to its points, R11 and R12 as fitted.

    Returns
    -------
    dict of str to Verdict
        Its cause is None where the sizes follow a beam, and one clearly of more than no emittance.
    """
    evidence = {}
    for plane, found in points.items():
        work = seen.works[plane]
        given = work.given._replace(r11=found.r11, r12=found.r12)
        evidence[plane] = work_on(plane, given, None, work.method).evidence
    clear = {plane: judge(e, None).cause is None for plane, e in evidence.items()}
    return {
        plane: judge(e, None, any(c for p, c in clear.items() if p != plane))
        for plane, e in evidence.items()
    }
