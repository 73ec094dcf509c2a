"""Emittance from a scan, by beamfit and by what others offer: value and error in m, normalised."""

from __future__ import annotations

import logging
from functools import cache, lru_cache

import emcee
import numpy as np
from scipy.optimize import curve_fit, minimize

import beamfit
from beamfit.emittance.many import fit_many
from beamfit.emittance.sensitivity import systematics
from beamfit.optics.elements import Drift, Quadrupole, Screen

from .answers import Answer, of_quantity
from .scans import Line, Scan

__all__ = ["systematics"]
MADE_UP = 0.015  # relative errors where the file has none: pyemittance's default


@cache
def beamfit_line(line: Line) -> beamfit.Beamline:
    parts = [
        Quadrupole(f"F{i}", length, k1) if k1 else Drift(f"D{i}", length)
        for i, (k1, length) in enumerate(line.rest)
    ]
    return beamfit.Beamline((Quadrupole("Q", line.length), *parts, Screen("S")), line.energy)


def beamfit_scan(scan: Scan) -> beamfit.QuadScan:
    error = {} if scan.error is None else {"x": scan.error}
    return beamfit.QuadScan({"Q": scan.k1}, {"Q": "k1"}, {"x": scan.size}, error)


def beamfit_fit(scan: Scan) -> beamfit.EmittanceFit:
    return beamfit.fit_emittance(beamfit_scan(scan), beamfit_line(scan.line))


def by_beamfit(scans: list[Scan]) -> list[dict[str, Answer]]:
    """All draws in one call. Any status but `converged` warns, and so does an error."""
    try:
        fits = fit_many([(beamfit_scan(scan), beamfit_line(scan.line)) for scan in scans])
    except beamfit.InputError:
        return [{} if len(scans) == 1 else by_beamfit([scan])[0] for scan in scans]
    return [{} if isinstance(fit, beamfit.InputError) else told(fit.x) for fit in fits]


def told(fit) -> dict[str, Answer]:
    sure = fit.status == "converged" and fit.normalized_emittance.error is not None
    return {"emittance": of_quantity(fit.normalized_emittance)} if sure else {}


def errors_of(scan: Scan) -> np.ndarray:
    return MADE_UP * scan.size if scan.error is None else scan.error


def by_pyemittance(scan: Scan) -> dict[str, Answer]:
    """Its thick-lens estimate with the weights of its EmitCalc."""
    from pyemittance.optics import estimate_sigma_mat_thick_quad, normalize_emit

    logging.disable(logging.CRITICAL)
    size, error, energy = scan.size, errors_of(scan), 1e6 * scan.line.energy
    found = estimate_sigma_mat_thick_quad(
        size,
        scan.k1 * scan.line.length,
        error,
        1 / size + 1 / (2 * size * error),
        Lquad=scan.line.length,
        energy=energy,
        rmats=(scan.line.after,) * 2,
        plot=False,
    )
    scale = scan.line.boost * found["emit_x"] / normalize_emit(found["emit_x"], energy)
    return {"emittance": Answer(scale * found["norm_emit_x"], scale * found["norm_emit_x_err"])}


def squares(rows: np.ndarray) -> np.ndarray:
    """Size² by σ11, σ12, σ22: shape (n, 3)."""
    return np.stack([rows[:, 0] ** 2, 2 * rows[:, 0] * rows[:, 1], rows[:, 1] ** 2], 1)


def emittance_of(sigma: np.ndarray) -> np.ndarray:
    """NaN for no beam."""
    return np.sqrt(sigma[..., 0] * sigma[..., 2] - sigma[..., 1] ** 2)


def propagated(sigma: np.ndarray, covariance: np.ndarray, boost: float) -> dict[str, Answer]:
    value = emittance_of(sigma)
    slope = np.array([sigma[2], -2 * sigma[1], sigma[0]]) / (2 * value)
    error = np.sqrt(slope @ covariance @ slope)
    return {"emittance": Answer(boost * float(value), boost * float(error))}


def fitted(scan: Scan, rows: np.ndarray) -> dict[str, Answer]:
    """scipy's curve_fit of size² with errors 2 x dx, propagated to the emittance."""
    design = squares(rows)
    scale = design.max()
    sigma, covariance = curve_fit(
        lambda _, *s: design / scale @ np.array(s),
        None,
        1e12 * scan.size**2,
        np.ones(3),
        None if scan.error is None else 2e12 * scan.size * scan.error,
        absolute_sigma=scan.error is not None,
    )
    return propagated(sigma, covariance, 1e-12 / scale * scan.line.boost)


def by_scipy(scan: Scan) -> dict[str, Answer]:
    return fitted(scan, scan.rows)


@lru_cache(64)
def cheetah_rows(line: Line, k1: tuple[float, ...]) -> np.ndarray:
    """R11 and R12 from cheetah, all settings at once."""
    import cheetah
    import torch

    torch.set_default_dtype(torch.float64)
    value = torch.tensor

    parts = [cheetah.Quadrupole(length=value(line.length), k1=value(k1))]
    for strength, length in line.rest:
        kind = cheetah.Quadrupole if strength else cheetah.Drift
        parts.append(kind(length=value(length), **({"k1": value(strength)} if strength else {})))
    energy, species = value(1e6 * line.energy), cheetah.Species("electron")
    maps = [part.first_order_transfer_map(energy, species)[..., :2, :2] for part in parts]
    matrix = maps[0]
    for one in maps[1:]:
        matrix = one @ matrix
    return matrix[..., 0, :].numpy()


def by_cheetah(scan: Scan) -> dict[str, Answer]:
    """cheetah has the optics, not the fit: its matrices, and the fit one writes beside them."""
    return fitted(scan, cheetah_rows(scan.line, tuple(scan.k1)))


def by_lmfit(scan: Scan) -> dict[str, Answer]:
    """Sizes by emittance, β and α, all bounded; lmfit scales errors by sqrt(χ²/dof) itself."""
    import lmfit

    rows = scan.rows

    def model(_, emittance, beta, alpha):
        gamma = (1 + alpha**2) / beta
        return np.sqrt(1e-6 * emittance * squares(rows) @ np.array([beta, -alpha, gamma]))

    beta, alpha = guess(scan)
    parameters = lmfit.Parameters()
    parameters.add("emittance", 1e6 * 1e-6 / scan.line.boost, min=0)
    parameters.add("beta", beta, min=1e-3)
    parameters.add("alpha", alpha)
    weights = None if scan.error is None else 1 / scan.error
    found = lmfit.Model(model).fit(scan.size, parameters, _=np.zeros(1), weights=weights)
    if not (found.success and found.errorbars):
        return {}
    value = found.params["emittance"]
    scale = 1e-6 * scan.line.boost
    return {"emittance": Answer(scale * value.value, scale * value.stderr)}


def guess(scan: Scan) -> tuple[float, float]:
    """β and α to begin with: the linear fit's, or those of a parallel beam."""
    sigma = np.linalg.pinv(squares(scan.rows)) @ scan.size**2
    with np.errstate(invalid="ignore"):
        value = emittance_of(sigma)
    if not value > 0 or sigma[0] <= 0:
        return 5.0, 0.0
    return float(sigma[0] / value), float(-sigma[1] / value)


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
    return {"emittance": Answer(1e-6 * scan.line.boost * float(emittance_of(sigma(found.x))), None)}


def by_sddsemitproc(scan: Scan, sets: int = 100) -> dict[str, Answer]:
    """sddsemitproc's method from its manual: linear fits of the sizes with random errors added,
    sets that are no beam left out, their mean and spread; the errors of the file, else made up."""
    rng = np.random.default_rng(0)
    inverse = np.linalg.pinv(squares(scan.rows))
    drawn = scan.size + errors_of(scan) * rng.normal(size=(sets, len(scan.size)))
    sigma = drawn**2 @ inverse.T
    with np.errstate(invalid="ignore"):
        found = emittance_of(sigma)[(sigma[:, 0] > 0) & (sigma[:, 2] > 0)]
    found = scan.line.boost * found[np.isfinite(found)]
    if found.size < 2:
        return {}
    return {"emittance": Answer(float(found.mean()), float(found.std(ddof=1)))}


def by_emcee(scan: Scan, walkers: int = 32, steps: int = 300) -> dict[str, Answer]:
    """A posterior by hand: flat in log ε, log β and α; median and half of the 68 % interval."""
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
    beta, alpha = guess(scan)
    start = np.array([np.log(1e-6 / scan.line.boost), np.log(beta), alpha])
    start = start + 0.1 * rng.normal(size=(walkers, 3))
    sampler = emcee.EnsembleSampler(walkers, 3, log_probability, vectorize=True)
    sampler._random.seed(1)
    sampler.run_mcmc(start, steps)
    low, middle, high = np.percentile(
        sampler.get_chain(discard=steps // 2, flat=True)[:, 0], [16, 50, 84]
    )
    value = scan.line.boost * np.exp(middle)
    return {"emittance": Answer(value, value * (np.exp(high - middle) - np.exp(low - middle)) / 2)}


# Name: (tool, one of how many draws it is given); beamfit is given all of them at once.
TOOLS = {
    "beamfit": (by_beamfit, 1),
    "pyemittance": (by_pyemittance, 1),
    "scipy curve_fit": (by_scipy, 1),
    "lmfit": (by_lmfit, 5),
    "cheetah + curve_fit": (by_cheetah, 1),
    "emcee by hand": (by_emcee, 40),
    "lcls-tools' method": (by_lcls_tools, 10),
    "sddsemitproc's method": (by_sddsemitproc, 1),
}
