"""Pages of all results other than scans and decays; imports every study."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from beamfit.density.fit import DensityFit
from beamfit.dynamics.control import Loop
from beamfit.dynamics.fedbatch import FedBatchFit
from beamfit.dynamics.feed import FeedPlan
from beamfit.dynamics.fit import ResponseFit
from beamfit.dynamics.state_fit import StatesFit
from beamfit.emittance.slices import SliceFits
from beamfit.errors import InputError
from beamfit.language.compiled import Computed
from beamfit.language.solution import ProblemSolution
from beamfit.lifetime.lifetime_table import LifetimeFit
from beamfit.report.density import density_page
from beamfit.report.document import ReportPage
from beamfit.report.dynamics import control_page, fedbatch_page, feed_page, response_page
from beamfit.report.emittance import slices_page
from beamfit.report.formulation import computed_page, formulation_page
from beamfit.report.lifetime_table import lifetime_table_page
from beamfit.report.tuning import tuning_page
from beamfit.tuning.fit import TuningFit

# Functions that make the page of one result, and of several results.
OF_ONE = {
    ProblemSolution: formulation_page,
    Computed: computed_page,
    SliceFits: slices_page,
    FedBatchFit: fedbatch_page,
    FeedPlan: feed_page,
    Loop: control_page,
    TuningFit: tuning_page,
    DensityFit: density_page,
}
OF_SEVERAL = dict.fromkeys((ResponseFit, StatesFit), response_page)
OF_SEVERAL |= {LifetimeFit: lifetime_table_page}


def page_of(several: Sequence[Any]) -> ReportPage:
    """Make the page of a result, or of several."""
    kind = type(several[0])
    if kind not in OF_ONE and kind not in OF_SEVERAL:
        raise InputError(f"a report of a {kind.__name__}", "a fit, or another result that has one")
    return OF_ONE[kind](several[0]) if kind in OF_ONE else OF_SEVERAL[kind](several)
