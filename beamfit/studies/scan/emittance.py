"""The emittance fit: a scan and a line in, a judged result out; here with known transport."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from beamfit.errors import InputError
from beamfit.optics.beamline import Beamline
from beamfit.optics.particle import beta_gamma
from beamfit.quantity import Quantity
from beamfit.statistics import scaled_directions
from beamfit.studies.scan.assumptions import Anchor, Assumptions
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.plane import PlaneWork, next_measurement, work_on
from beamfit.studies.scan.results import Identifiability, PlaneFit, ScreenTwiss
from beamfit.studies.scan.scans import QuadScan, check_names
from beamfit.studies.scan.transport import (
    names_of,
    own_settings,
    own_units,
    plane_input,
    scan_rows,
    scanned_line,
    transfer_rows,
)
from beamfit.studies.scan.verdict import LOST, Verdict, judge, phase_coverage

__all__ = ["fit_emittance"]

METHODS = ("size_squared", "size")


def fit_emittance(
    scan: QuadScan,
    line: Beamline,
    *,
    planes: tuple[str, ...] | None = None,
    method: str = "size_squared",
    robust: bool = False,
    scenario: str = "known",
    priors: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    anchor: Anchor | None = None,
    hysteresis: bool = False,
    hidden: int = 5,
    starts: int = 20,
    seed: int = 0,
) -> EmittanceFit:
    """Fit the beam matrix at the start of a line to a scan, and judge the result.

    Parameters
    ----------
    scan : QuadScan
        The measured sizes.
    line : Beamline
        The line, from where the beam matrix is wanted to the screens.
    planes : tuple of str, optional
        ("x",), ("y",) or both; all planes of the scan if None.
    method : {"size_squared", "size"}
        The residual: the report's ``error_linear`` or ``error_nonlinear``.
    robust : bool
        Give each point a probability of being an outlier (with "size_squared").
    scenario : {"known", "transport-network", "calibration", "focusing-network"}
        What is unknown besides the beam: nothing; R11 and R12; slope and offset of the scanned
        magnets' calibration; k1 as a function of the current. All planes are then fitted
        together. See docs/scenarios.md for what each cannot know.
    priors, bounds : mapping of str to (float, float), optional
        Calibration number, such as "Q2.slope", to mean and standard deviation, or to lower and
        upper bound ("calibration").
    anchor : Anchor, optional
        What ties a network to first principles.
    hysteresis : bool
        Two branches of k1, for rising and falling currents ("focusing-network").
    hidden, starts, seed : int
        Hidden nodes of a network, starts of its training, seed of their random numbers.

    Returns
    -------
    EmittanceFit
        Values, errors, statuses and sentences; `print` it.

    Raises
    ------
    InputError
        If the line lacks a magnet or screen of the scan, or an option is unknown.

    Notes
    -----
    One geometric beam matrix at the start is common to all rows, also where their energies
    differ. Errors are those of the linear theory of least squares, propagated to ε, β, α by
    their gradients; see docs/emittance.md.

    Examples
    --------
    >>> from beamfit.optics.beam import BeamMatrix
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), energy=135.0)
    >>> k1 = np.linspace(-2.0, 12.0, 8)
    >>> sizes = [float(BeamMatrix.from_twiss(2e-9, 5.0, 0.0).transport(
    ...     line.matrix({"Q": k}).x).l11) for k in k1]
    >>> scan = QuadScan({"Q": k1}, {"Q": "k1"}, {"x": sizes}, {"x": 0.02 * np.array(sizes)})
    >>> fit = fit_emittance(scan, line)
    >>> fit.x.status.value, f"{fit.x.emittance.value * 1e9:.4f} nm"
    ('converged', '2.0000 nm')
    """
    _check_options(method, robust)
    told = Assumptions(
        priors or {}, bounds or {}, anchor or Anchor(), hysteresis, hidden, starts, seed
    )
    told.check_scenario(scenario)
    if scenario != "known":
        if robust:
            raise InputError(f"a robust fit in scenario {scenario}", "scenario known")
        from beamfit.studies.scan.scenarios import fit_scenario  # loads the grey-box core

        return fit_scenario(scan, line, scenario, told, planes, method)
    check_names(scan, *names_of(line))
    scanned = scanned_line(scan, line)
    asked = planes or scan.planes
    # A plane that is not asked for still testifies to the settings and the optics.
    rows = scan_rows(scan, scanned)
    matrices = transfer_rows(scanned, rows.settings, rows.energy, places=rows.places)
    works = {
        plane: work_on(
            plane,
            plane_input(scan, scanned, rows, matrices, plane),
            getattr(line.design, plane, None),
            method,
            robust,
        )
        for plane in dict.fromkeys((*asked, *scan.planes))
    }
    clear = {plane: judge(w.evidence, None).cause is None for plane, w in works.items()}
    fits = []
    for plane in asked:
        work, beside = works[plane], any(c for p, c in clear.items() if p != plane)
        verdict, advice = judge(work.evidence, None, beside), None
        if verdict.cause is not None:
            advice = next_measurement(work, scanned)
            verdict = judge(work.evidence, advice, beside)
        verdict = verdict._replace(message=verdict.message + _outlier_words(work))
        fits.append(_plane_fit(work, line, verdict, advice))
    return EmittanceFit(tuple(fits), scan, line)


def _outlier_words(work: PlaneWork) -> str:
    """Name the points the robust fit doubts."""
    probability = work.points.outlier_probability
    doubted = [] if probability is None else np.flatnonzero(probability > 0.5)
    if not len(doubted):
        return ""
    places = [
        ", ".join(
            f"{n} = {v[i]:.4g} {work.points.units[n]}" for n, v in work.points.settings.items()
        )
        for i in doubted
    ]
    return (
        f" {len(doubted)} of {len(probability)} points more likely outliers than not: "
        + "; ".join(places)
        + "."
    )


def _check_options(method: str, robust: bool) -> None:
    if method not in METHODS:
        raise InputError(f"method '{method}'", "size_squared or size")
    if robust and method != "size_squared":
        raise InputError("a robust fit of size", 'method "size_squared" with robust')


def _plane_fit(w: PlaneWork, line: Beamline, verdict: Verdict, advice: str | None) -> PlaneFit:
    """Assemble the result: errors only for what the data determine."""
    sigma, e, d = w.fit.sigma, w.evidence, w.derived
    determined = verdict.cause is None
    # The three numbers of size² can be known although the emittance is not.
    linear = determined or (e.full_rank and e.positive and e.misfit <= LOST and e.dof > 0)

    def quantity(value: float, raw: float, unit: str, known: bool = determined) -> Quantity:
        if not known or not math.isfinite(raw):
            return Quantity(float(value), None, unit)
        return Quantity(float(value), float(raw) * w.scale, unit, float(raw))

    emittance, error = (float(d.start[0]) if e.positive else 0.0), d.start_error[0]
    factor = float(beta_gamma(w.given.energy.mean(), line.mass))
    raw = np.sqrt(np.diagonal(w.covariance))
    residual = float(np.sqrt(np.mean((w.points.size - w.points.model) ** 2)))
    return PlaneFit(
        plane=w.plane,
        status=verdict.status,
        message=verdict.message,
        emittance=quantity(emittance, error, "m"),
        normalized_emittance=quantity(factor * emittance, factor * error, "m"),
        beta=quantity(d.start[1], d.start_error[1], "m"),
        alpha=quantity(d.start[2], d.start_error[2], "1"),
        sigma=tuple(
            quantity(sigma[i], raw[i], unit, linear)
            for i, unit in enumerate(("m^2", "m rad", "rad^2"))
        ),
        screen=ScreenTwiss(
            name=w.given.last_screen,
            settings=own_settings(line, w.given.last_screen),
            units=own_units(line, w.given.last_screen),
            beta=quantity(d.screen[0], d.screen_error[0], "m"),
            alpha=quantity(d.screen[1], d.screen_error[1], "1"),
            size=quantity(d.screen[2], d.screen_error[2], "m", linear),
        ),
        mismatch=None
        if getattr(line.design, w.plane, None) is None
        else quantity(d.mismatch, d.mismatch_error, "1"),
        chi2=e.chi2 if e.noise_known else None,
        dof=e.dof,
        rms_residual=Quantity(residual, None, "m"),
        covariance=w.covariance if linear else np.full((3, 3), np.nan),
        error_scale=w.scale,
        noise="given" if e.noise_known else "inferred from the residuals",
        method=w.method,
        identifiability=_identifiability(w, determined, advice),
        points=w.points,
    )


def _identifiability(w: PlaneWork, determined: bool, advice: str | None) -> Identifiability:
    p, sigma, e = w.points, w.fit.sigma, w.evidence
    unit = np.array([sigma[0], math.sqrt(max(sigma[0] * sigma[2], 0.0)), sigma[2]])
    design = np.stack([p.r11**2, 2 * p.r11 * p.r12, p.r12**2], -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian = design / (2.0 * p.size * p.error * w.scale)[:, None]
    found = scaled_directions(jacobian, unit, ["sigma11", "sigma12", "sigma22"])
    open_ones = found.undetermined if determined else (*found.undetermined, "emittance")
    beta, alpha = float(w.derived.start[1]), float(w.derived.start[2])
    return Identifiability(
        determined=determined,
        singular_values=tuple(float(v) for v in found.singular_values),
        condition=found.condition if math.isfinite(found.condition) else None,
        waist_bracketed=e.bracketed,
        phase_coverage=phase_coverage(p.r11, p.r12, beta, alpha),
        zero_distance=min(e.determinant_distance, e.zero_distance),
        undetermined=open_ones,
        next_measurement=advice,
    )
