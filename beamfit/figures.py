"""Figures of results, each a matplotlib Figure: the pictures of the report, one by one.

A figure has no window: save it with ``figure.savefig``, or show it in a notebook.

>>> import beamfit, beamfit.figures
>>> record = beamfit.read_decay_record("measurements/aps_1999_decay.csv")
>>> figure = beamfit.figures.decay(beamfit.fit_decay(record))
>>> len(figure.axes)
2
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from beamfit.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from beamfit.emittance.fit import EmittanceFit
    from beamfit.lifetime.course import Trend
    from beamfit.lifetime.fit import DecayFit
    from beamfit.lifetime.ring_study import Shift
    from beamfit.lifetime.study import Decay, RecordStudy
    from beamfit.report.document import Picture
    from beamfit.sampling.posterior import Posterior

__all__ = [
    "decay",
    "lifetime",
    "network",
    "pairs",
    "phase_space",
    "picture",
    "residuals",
    "scan",
    "trend",
]


def picture(result: Any, **options: Any) -> Figure:
    """Draw the first picture of a result's report; ``result.plot()`` calls this.

    Parameters
    ----------
    result : EmittanceFit, DecayFit, RecordStudy, Trend, Posterior, or another result with a report
        Result to draw.
    **options
        Options of the drawing function of this module, such as ``plane="y"`` for a scan.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        If its report has no picture.
    """
    from beamfit.emittance.fit import EmittanceFit
    from beamfit.lifetime.course import Trend
    from beamfit.lifetime.fit import DecayFit
    from beamfit.lifetime.study import RecordStudy
    from beamfit.report.kinds import OF_ONE, OF_SEVERAL, page_of
    from beamfit.sampling.posterior import Posterior

    own = {EmittanceFit: scan, DecayFit: decay, RecordStudy: decay, Trend: trend, Posterior: pairs}
    if type(result) in own:
        return own[type(result)](result, **options)
    reported = type(result) in OF_ONE or type(result) in OF_SEVERAL
    drawn = page_of((result,)).pictures if reported else ()
    if not drawn:
        expected = "a result whose report has one, such as a fit"
        raise InputError(f"no picture of a {type(result).__name__}", expected)
    return _render(drawn[0])


def scan(fit: EmittanceFit, plane: str | None = None) -> Figure:
    """Draw measured sizes with the fit, its error band, and the residuals below.

    Parameters
    ----------
    fit : EmittanceFit
        The fit.
    plane : str, optional
        "x" or "y"; the first that was fitted if None.

    Returns
    -------
    matplotlib.figure.Figure
    """
    from beamfit.report.scan_pictures import scan_picture

    return _render(scan_picture(fit, _plane(fit, plane)))


def residuals(fit: EmittanceFit, plane: str | None = None) -> Figure:
    """Draw the residuals of one plane in standard errors; arguments as for `scan`."""
    from beamfit.report.scan_pictures import residual_picture

    return _render(residual_picture(fit, _plane(fit, plane)))


def phase_space(fit: EmittanceFit) -> Figure:
    """Draw the one-sigma phase ellipses of the planes whose β and α are determined.

    Parameters
    ----------
    fit : EmittanceFit
        The fit.

    Returns
    -------
    matplotlib.figure.Figure
        At the start of the line and at the screen.

    Raises
    ------
    InputError
        If the data determine β and α of no plane.
    """
    from beamfit.report.scan_pictures import ellipse_picture, has_ellipses

    if not any(has_ellipses(p) for p in fit.planes):
        expected = "a plane whose beta and alpha the data determine"
        raise InputError("a fit without phase ellipses", expected, path=fit.scan.path)
    return _render(ellipse_picture(fit))


def decay(result: DecayFit | RecordStudy) -> Figure:
    """Draw a record of beam current with the fit of each decay, and the residuals below.

    Parameters
    ----------
    result : DecayFit or RecordStudy
        Fit of one decay, or of a whole record.

    Returns
    -------
    matplotlib.figure.Figure
    """
    from beamfit.report.lifetime import record_picture, study_of

    return _render(record_picture(study_of(result)))


def lifetime(result: DecayFit | RecordStudy) -> Figure:
    """Draw the momentary lifetime along a record and that of the fit; argument as for `decay`."""
    from beamfit.report.lifetime import lifetime_picture, study_of

    return _render(lifetime_picture(study_of(result)))


def pairs(posterior: Posterior, names: Sequence[str] | None = None) -> Figure:
    """Draw the distribution of each sampled number and of each pair.

    Parameters
    ----------
    posterior : Posterior
        With draws.
    names : sequence of str, optional
        Numbers to draw, such as ``x.emittance``; the first five shown ones if None.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        If nothing was sampled, or a name is unknown.
    """
    from beamfit.report.posterior import MAX_NUMBERS, pairs_picture

    names = tuple(names or posterior.shown[:MAX_NUMBERS])
    if not posterior.chain.size:
        raise InputError("a posterior without draws", posterior.message)
    return _render(pairs_picture(posterior, names))


def trend(result: Trend) -> Figure:
    """Draw normalised lifetimes with control limits and alarms; a and b over their reference below.

    Parameters
    ----------
    result : Trend
        Result of `beamfit.lifetime.course.trend_of`.

    Returns
    -------
    matplotlib.figure.Figure
    """
    from beamfit.report.lifetime import trend_picture

    return _render(trend_picture(result))


def network(shift: Shift, decays: Sequence[Decay], setting: str | None = None) -> Figure:
    """Draw predictions of corrected first principles with decays, or against one setting.

    Parameters
    ----------
    shift : Shift
        A study with a network.
    decays : sequence of Decay
        Decays of the study.
    setting : str, optional
        "rf_voltage", "scraper_y" or "bunches": a, b and lifetime against it. Otherwise four decays.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        If the study has no network, or there is no such setting.
    """
    from beamfit.report.network import SETTINGS, decays_picture, setting_picture

    if shift.network is None:
        raise InputError("a study without a network", "study_shift(..., network=True)")
    if setting is None:
        return _render(decays_picture(shift, decays))
    if setting not in SETTINGS:
        raise InputError(f"a setting '{setting}'", " or ".join(SETTINGS))
    return _render(setting_picture(shift, decays, setting))


def _plane(fit: EmittanceFit, plane: str | None) -> str:
    """Return the requested plane, or the first."""
    fitted = [p.plane for p in fit.planes]
    if plane is not None and plane not in fitted:
        raise InputError(f"no fit of plane '{plane}'", " or ".join(fitted))
    return plane or fitted[0]


def _render(picture: Picture) -> Figure:
    """Draw a picture of the report, in its style."""
    from beamfit.report.document import figure_of, own_style

    with own_style():
        return figure_of(picture)
