"""Emittance from a scan, by beamfit and by what others offer: value and intervals in m."""

from __future__ import annotations

import logging

import emcee
import numpy as np
from scipy.optimize import curve_fit, minimize

import beamfit
from beamfit.emittance.fit import fit_many
from beamfit.emittance.systematics import systematics

from .. import verdict
from .answers import Answer, of_draws, of_quantity, of_sigma
from .scans import Scan

MADE_UP = 0.015  # relative errors where the file has none: pyemittance's default


def beamfit_fit(scan: Scan) -> beamfit.EmittanceFit:
    return beamfit.fit_emittance(scan.given, verdict.beamline(scan.line))


def by_beamfit(scans: list[Scan]) -> list[dict[str, Answer]]:
    """All draws in one call. Any status but `converged` warns, and so does an error."""
    fits = fit_many([(scan.given, verdict.beamline(scan.line)) for scan in scans])
    return [{} if isinstance(fit, beamfit.InputError) else stands_for(fit.x) for fit in fits]


def stands_for(fit) -> dict[str, Answer]:
    sure = fit.status == "converged" and fit.emittance.error is not None
    return {"emittance": of_quantity(fit.emittance)} if sure else {}


def says(scan: Scan, cause: str) -> str:
    """What beamfit says where the data show nothing: its budget's row, else its message."""
    fit = beamfit_fit(scan)
    emittance = fit.x.emittance
    rows = [c for c in systematics(fit, "x") if cause and cause in c.cause]
    if not rows or not emittance.error:
        return f"status `{fit.x.status}`: {fit.x.message.split('. ')[0].rstrip('.')}"
    statistics = f"statistics ±{100 * emittance.error / emittance.value:.1f} %"
    return f"{statistics}; budget: *{rows[0].cause}*, emittance {100 * rows[0].emittance:+.1f} %"


def errors_of(scan: Scan) -> np.ndarray:
    return MADE_UP * scan.size if scan.error is None else scan.error


def by_pyemittance(scan: Scan) -> dict[str, Answer]:
    """Its thick-lens estimate with the weights of its EmitCalc, as its get_emit calls it."""
    from pyemittance.optics import estimate_sigma_mat_thick_quad

    logging.disable(logging.CRITICAL)
    size, error = scan.size, errors_of(scan)
    found = estimate_sigma_mat_thick_quad(
        size,
        scan.k1 * scan.line.length,
        error,
        1 / size + 1 / (2 * size * error),
        Lquad=scan.line.length,
        energy=1e6 * verdict.ENERGY,
        rmats=(scan.line.after,) * 2,
        plot=False,
    )
    return {"emittance": of_sigma(found["emit_x"], found["emit_x_err"])}


def squares(rows: np.ndarray) -> np.ndarray:
    """Size² by σ11, σ12, σ22: shape (n, 3)."""
    return np.stack([rows[:, 0] ** 2, 2 * rows[:, 0] * rows[:, 1], rows[:, 1] ** 2], 1)


def emittance_of(sigma: np.ndarray) -> np.ndarray:
    """NaN for no beam."""
    return np.sqrt(sigma[..., 0] * sigma[..., 2] - sigma[..., 1] ** 2)


def by_scipy(scan: Scan) -> dict[str, Answer]:
    """The script one writes: curve_fit of size² with errors 2 x dx, propagated to the emittance."""
    design, known = squares(scan.rows), scan.error is not None
    scale = design.max()
    sigma, covariance = curve_fit(
        lambda _, *s: design / scale @ np.array(s),
        None,
        1e12 * scan.size**2,
        np.ones(3),
        2e12 * scan.size * scan.error if known else None,
        absolute_sigma=known,
    )
    value = emittance_of(sigma)
    slope = np.array([sigma[2], -2 * sigma[1], sigma[0]]) / (2 * value)
    error, unit = np.sqrt(slope @ covariance @ slope), 1e-12 / scale
    freedom = np.inf if known else len(design) - 3
    return {"emittance": of_sigma(unit * float(value), unit * error, freedom)}


def by_lmfit(scan: Scan) -> dict[str, Answer]:
    """Sizes by emittance, β and α, all bounded; lmfit scales errors by sqrt(χ²/dof) itself."""
    import lmfit

    rows = scan.rows

    def model(_, emittance, beta, alpha):
        gamma = (1 + alpha**2) / beta
        return np.sqrt(1e-9 * emittance * squares(rows) @ np.array([beta, -alpha, gamma]))

    beta, alpha, first = guess(scan)
    parameters = lmfit.Parameters()
    parameters.add("emittance", first, min=0)
    parameters.add("beta", beta, min=1e-3)
    parameters.add("alpha", alpha)
    weights = None if scan.error is None else 1 / scan.error
    found = lmfit.Model(model).fit(scan.size, parameters, _=np.zeros(1), weights=weights)
    if not (found.success and found.errorbars):
        return {}
    value = found.params["emittance"]
    return {"emittance": of_sigma(1e-9 * value.value, 1e-9 * value.stderr, found.nfree)}


def guess(scan: Scan) -> tuple[float, float, float]:
    """β, α and emittance (nm) to begin with: the linear fit's, or those of a parallel beam."""
    sigma = np.linalg.pinv(squares(scan.rows)) @ scan.size**2
    with np.errstate(invalid="ignore"):
        value = emittance_of(sigma)
    if not value > 0 or sigma[0] <= 0:
        return 5.0, 0.0, 1.0
    return float(sigma[0] / value), float(-sigma[1] / value), 1e9 * float(value)


def by_lcls_tools(scan: Scan) -> dict[str, Answer]:
    """lcls-tools' method from its description: least absolute miss of the sizes, σ kept positive
    by two roots and a bounded correlation, started from the pseudo-inverse. It gives no error."""
    design, size = squares(scan.rows), 1e3 * scan.size  # its unit is mm

    def sigma(p):
        return np.array([p[0] ** 2, p[0] * p[1] * p[2], p[1] ** 2])

    def loss(p):
        return np.nansum(np.abs(np.sqrt(design @ sigma(p)) - size))

    first = np.linalg.pinv(design) @ size**2
    one, two = np.sqrt(np.maximum(first[[0, 2]], 1e-6))
    limit = 1 - 1e-6
    start = one, two, np.clip(first[1] / one / two, -limit, limit)
    found = minimize(loss, start, bounds=[(None, None), (None, None), (-limit, limit)])
    return {"emittance": Answer(1e-6 * float(emittance_of(sigma(found.x))))}


def by_sddsemitproc(scan: Scan, sets: int = 100) -> dict[str, Answer]:
    """sddsemitproc's method from its manual: linear fits of the sizes with random errors added,
    sets that are no beam left out, their mean and spread; the errors of the file, else made up."""
    rng = np.random.default_rng(0)
    inverse = np.linalg.pinv(squares(scan.rows))
    drawn = scan.size + errors_of(scan) * rng.normal(size=(sets, len(scan.size)))
    sigma = drawn**2 @ inverse.T
    with np.errstate(invalid="ignore"):
        found = emittance_of(sigma)[(sigma[:, 0] > 0) & (sigma[:, 2] > 0)]
    found = found[np.isfinite(found)]
    if found.size < 2:
        return {}
    return {"emittance": of_sigma(float(found.mean()), float(found.std(ddof=1)))}


def by_emcee(scan: Scan, walkers: int = 32, steps: int = 300) -> dict[str, Answer]:
    """A posterior by hand: flat in log ε, log β and α."""
    design, size = squares(scan.rows), scan.size
    error = MADE_UP * size if scan.error is None else scan.error

    def log_probability(p):
        beta = np.exp(p[:, 1])
        twiss = np.stack([beta, -p[:, 2], (1 + p[:, 2] ** 2) / beta], 1)
        model = np.sqrt(np.exp(p[:, :1]) * (twiss @ design.T))
        value = -0.5 * np.sum(((model - size) / error) ** 2, 1)
        outside = (
            (p[:, 0] < -40) | (p[:, 0] > -5) | (np.abs(p[:, 1]) > 12) | (np.abs(p[:, 2]) > 1e3)
        )
        return np.where(outside | ~np.isfinite(value), -np.inf, value)

    rng = np.random.default_rng(1)
    beta, alpha, value = guess(scan)
    start = np.array([np.log(1e-9 * value), np.log(beta), alpha])
    start = start + 0.1 * rng.normal(size=(walkers, 3))
    sampler = emcee.EnsembleSampler(walkers, 3, log_probability, vectorize=True)
    sampler._random.seed(1)
    sampler.run_mcmc(start, steps)
    chain = sampler.get_chain(discard=steps // 2, flat=True)[:, 0]
    return {"emittance": of_draws(np.exp(chain))}


# Name: (tool, one of how many draws it is given); beamfit is given all of them at once.
TOOLS = {
    "beamfit": (by_beamfit, 1),
    "pyemittance": (by_pyemittance, 1),
    "curve_fit": (by_scipy, 1),
    "lmfit": (by_lmfit, 1),
    "emcee": (by_emcee, 10),
    "lcls-tools' method": (by_lcls_tools, 1),
    "sddsemitproc's method": (by_sddsemitproc, 1),
}
