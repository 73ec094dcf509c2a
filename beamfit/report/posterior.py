"""What a report says of a sampled posterior: verdict, intervals, correlations, diagnostics."""

from __future__ import annotations

from collections.abc import Sequence

from beamfit.report.document import Page, Picture, Table, Verdict
from beamfit.report.posterior_figures import beam_posterior_pictures, decay_posterior_pictures
from beamfit.sampling.posterior import Posterior
from beamfit.sampling.text import HEADER, diagnostic_rows, interval_rows, plain_name
from beamfit.studies.decay.result import DecayFit
from beamfit.studies.scan.fit import EmittanceFit

__all__ = ["with_beam_posterior", "with_decay_posteriors"]

INTERVALS = (
    "Central credible intervals of the sampled posterior. Where the prior or the bounds decide a "
    "number and not the data, none is given."
)
MOST_CORRELATED = 8


def with_beam_posterior(page: Page, fit: EmittanceFit, posterior: Posterior) -> Page:
    """Add a posterior to the page of an emittance fit.

    Parameters
    ----------
    page : Page
        Of the fit.
    fit : EmittanceFit
        The fit.
    posterior : Posterior
        Of its `sample`.

    Returns
    -------
    Page
    """
    return _added(page, [("", posterior)], beam_posterior_pictures(fit, posterior))


def with_decay_posteriors(page: Page, pairs: Sequence[tuple[DecayFit, Posterior]]) -> Page:
    """Add the posteriors of decays to their page."""
    pictures = [picture for fit, found in pairs for picture in decay_posterior_pictures(fit, found)]
    names = [(f"{fit.record}: " if len(pairs) > 1 else "", found) for fit, found in pairs]
    return _added(page, names, pictures)


def _added(page: Page, named: Sequence[tuple[str, Posterior]], pictures: list[Picture]) -> Page:
    verdicts = [
        Verdict(found.status.value, f"{name}posterior {_headline(found)}", found.message)
        for name, found in named
    ]
    intervals = [
        Table(f"{name}Posterior", HEADER, interval_rows(found), INTERVALS) for name, found in named
    ]
    further = [
        table
        for name, found in named
        if found.chain.size
        for table in (_correlations(name, found), _diagnostics(name, found))
    ]
    return page._replace(
        verdicts=page.verdicts + verdicts,
        tables=page.tables[:1] + intervals + page.tables[1:] + further,
        pictures=page.pictures + pictures,
    )


def _headline(found: Posterior) -> str:
    return "sampled" if found.chain.size else "not sampled"


def _correlations(name: str, found: Posterior) -> Table:
    names = [each for each in found.shown if not each.endswith(".emittance")]
    names = [each for each in names if "sigma" not in each][:MOST_CORRELATED] or names
    values = found.correlations(names).values
    count = len(names)
    rows = [
        [
            f"{i + 1} {plain_name(each)}",
            *(_coefficient(v) for v in row[: i + 1]),
            *[""] * (count - i - 1),
        ]
        for i, (each, row) in enumerate(zip(names, values, strict=True))
    ]
    title = f"{name}Correlations of the posterior"
    return Table(title, ["", *(str(i + 1) for i in range(count))], rows, numeric=True)


def _coefficient(value: float) -> str:
    """Two digits, and more where one and nearly one would look the same."""
    nearly_one = 0.99 < abs(value) < 0.99995
    return f"{value:.4f}" if nearly_one else f"{value:.2f}".replace("-0.00", "0.00")


def _diagnostics(name: str, found: Posterior) -> Table:
    rows = [[label, *cells] for label, cells in diagnostic_rows(found)]
    return Table(f"{name}How the posterior was sampled", [], rows)
