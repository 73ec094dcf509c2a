"""Writing of reports: one self-contained HTML page, the same as PDF, or the pictures alone."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from beamfit.emittance.fit import EmittanceFit
from beamfit.errors import InputError
from beamfit.lifetime.fit import DecayFit
from beamfit.lifetime.study import RecordStudy
from beamfit.report import kind_of
from beamfit.report.document import (
    Picture,
    ReportPage,
    html_of,
    image_of,
    own_style,
    with_provenance,
)
from beamfit.report.emittance import emittance_page
from beamfit.report.posterior import ReportedPosterior, of_decay, of_scan, with_posteriors
from beamfit.sampling.posterior import Posterior
from beamfit.writing import write_atomically

if TYPE_CHECKING:
    from beamfit.dynamics.control import Loop
    from beamfit.dynamics.fedbatch import FedBatchFit
    from beamfit.dynamics.feed import FeedPlan
    from beamfit.dynamics.fit import ResponseFit
    from beamfit.emittance.size_methods import SizeMethods
    from beamfit.emittance.slices import SliceFits
    from beamfit.language.solution import ProblemSolution
    from beamfit.lifetime.course import Trend
    from beamfit.lifetime.ring_study import Shift

    Reported = (
        EmittanceFit | SliceFits | DecayFit | ProblemSolution | ResponseFit | Loop
        | FedBatchFit | FeedPlan
    )  # fmt: skip


def write_report(
    path: str | PathLike[str],
    result: Reported | Sequence[RecordStudy] | Sequence[ResponseFit],
    posterior: Posterior | Sequence[Posterior] | None = None,
    *,
    command: str | None = None,
    inputs: Mapping[str, str | None] | None = None,
    shift: Shift | None = None,
    trend: Trend | None = None,
    methods: tuple[SizeMethods, ...] = (),
) -> None:
    """Write a report page of a fit.

    Parameters
    ----------
    path : str or path
        File name: ``.html`` (self-contained) or ``.pdf`` for a page; ``.png`` or ``.svg`` for the
        pictures, the first under this name. An existing file is replaced atomically.
    result : EmittanceFit, SliceFits, DecayFit, ProblemSolution, ResponseFit, Loop, or sequence
        The emittance of a scan or of the slices of a beam, the lifetime of a decay or a table, a
        solved formulation, the response of a process, a simulated loop, a fed-batch process or its
        planned feed; or a sequence of RecordStudy (lifetimes of whole records) or of ResponseFit
        (several outputs).
    posterior : Posterior or sequence of Posterior, optional
        Result of ``fit.sample``; for records one for each decay.
    command : str, optional
        The command that made it.
    inputs : mapping of str to str, optional
        Input files and their SHA-256; those of the result if None.
    shift : Shift, optional
        The study of all decays together, shown first.
    trend : Trend, optional
        The trend of their lifetimes, shown first.
    methods : tuple of SizeMethods
        Results with other size methods of a scan.

    Raises
    ------
    InputError
        If the suffix is unknown, there is no picture, or the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import beamfit
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> line = beamfit.Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
    >>> sizes = [3.4e-4, 1.9e-4, 0.9e-4, 1.9e-4, 3.4e-4]
    >>> scan = beamfit.QuadScan({"Q": [-1.0, 1.5, 4.0, 6.5, 9.0]}, {"Q": "k1"}, {"x": sizes})
    >>> page = Path(tempfile.mkdtemp()) / "scan.html"
    >>> write_report(page, beamfit.fit_emittance(scan, line))
    >>> page.read_text().startswith("<!DOCTYPE html>")
    True
    """
    kind_of(path)  # raises for an unknown suffix
    several = tuple(result) if isinstance(result, list | tuple) else (result,)
    sampled: list[ReportedPosterior] = []
    first = several[0]
    if isinstance(first, EmittanceFit):
        page = emittance_page(first, methods)
        sampled = [] if posterior is None else [of_scan(first, posterior)]
    elif isinstance(first, DecayFit | RecordStudy):
        from beamfit.report.lifetime import decay_page, study_of

        studies = (study_of(first),) if isinstance(first, DecayFit) else several
        page = decay_page(studies, shift, trend)
        sampled = _of_decays(studies, posterior)
    else:
        from beamfit.report.kinds import page_of

        page = page_of(several)
    write_page(path, with_posteriors(page, sampled), command, inputs)


@own_style()
def write_page(
    path: str | PathLike[str],
    page: ReportPage,
    command: str | None = None,
    inputs: Mapping[str, str | None] | None = None,
) -> None:
    """Write a page in the format given by the suffix; see `write_report`."""
    page = with_provenance(page, command, inputs)
    match kind_of(path):
        case ".html":
            made = {Path(path): html_of(page)}
        case ".pdf":
            from beamfit.report.pdf import pdf_of

            made = {Path(path): pdf_of(page)}
        case _:
            made = _pictures(Path(path), page.pictures)
    for place, content in made.items():
        write_atomically(place, content)


def _pictures(path: Path, pictures: Sequence[Picture]) -> dict[Path, bytes]:
    """Render the pictures: the first under the given name, others with number and content."""
    if not pictures:
        raise InputError(f"report '{path}' without a picture", "a name ending in .html or .pdf")
    made = {}
    for number, picture in enumerate(pictures, 1):
        shows = re.sub(r"\W+", "-", picture.alt.lower())
        place = path if number == 1 else path.with_stem(f"{path.stem}-{number}-{shows}")
        made[place] = image_of(picture, path.suffix.lower().removeprefix("."))
    return made


def _of_decays(
    studies: Sequence[RecordStudy], posterior: Posterior | Sequence[Posterior] | None
) -> list[ReportedPosterior]:
    if posterior is None:
        return []
    found = [posterior] if isinstance(posterior, Posterior) else posterior
    fits = [decay.fit for study in studies for decay in study.answers]
    many = len(fits) > 1
    pairs = zip(fits, found, strict=True)
    return [of_decay(fit, one, f"{fit.record}: " if many else "") for fit, one in pairs]
