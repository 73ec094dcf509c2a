"""Network that corrects first principles: ln a and ln b at any setting (report 3.4.2).

The signs of its weights make the correction fall with bunches and scraper opening and rise with
pressure everywhere, not only at the data. First principles do so too, hence also the product.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.linalg import block_diag, cho_solve, cholesky, solve_triangular

from beamfit.answer import Row, json_of, shown
from beamfit.errors import InputError
from beamfit.greybox.fit import Fit
from beamfit.greybox.mlp import MLP, Port
from beamfit.greybox.problem import Prior, Problem, Record
from beamfit.greybox.signed_network import GainCertificate, certificate_of, signed_network
from beamfit.greybox.solve import solve
from beamfit.lifetime.mechanisms import SCALES, scaled_losses, terms_at_voltages
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.scales import ScaleFit, loss_parts
from beamfit.lifetime.study import Decay, settings_of
from beamfit.quantity import HOUR, Quantity, percent

# Inputs and outputs of the network.
INPUTS = ("rf_voltage", "scraper_y", "pressure", "bunches")
OUTPUTS = ("log_a", "log_b")
# Sign of the slope of the loss by each input; that by the RF voltage is not known.
SIGNS = {"scraper_y": -1, "pressure": 1, "bunches": -1}
# The same as a matrix, shape (outputs, inputs), 0 for unknown.
RISING = np.array([[SIGNS.get(name, 0) for name in INPUTS]] * len(OUTPUTS))


def network_inputs(
    rf_voltage: float, scraper_y: float, pressure: float, bunches: float
) -> np.ndarray:
    """Network inputs, MV and logarithms of mm, nPa and number, from V, m, Pa and number."""
    values = np.array([1e3 * scraper_y, 1e9 * pressure, bunches], float)
    return np.array([1e-6 * float(rf_voltage), *np.log(values)])


class Box(NamedTuple):
    """Operating box: ranges of the settings, in SI units, over which a network is certified.

    Parameters
    ----------
    rf_voltage, scraper_y, pressure, bunches : (float, float)
        Ranges in V, m, Pa at the mean current, and number.

    Raises
    ------
    InputError
        From `corners`, if a range is empty or not positive and finite.

    Examples
    --------
    >>> box = Box((1.6e6, 3.2e6), (3e-3, 6e-3), (1e-8, 1e-7), (100, 300))
    >>> box.corners()[0].round(2).tolist()
    [1.6, 1.1, 2.3, 4.61]
    """

    rf_voltage: tuple[float, float]
    scraper_y: tuple[float, float]
    pressure: tuple[float, float]
    bunches: tuple[float, float]

    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner in network inputs."""
        for name, (low, high) in zip(self._fields, self, strict=True):
            if not 0 < low <= high < np.inf:
                expected = "0 < lower <= upper, finite"
                raise InputError(f"range {low:g} to {high:g}", expected, column=name)
        low, high = np.array(self, float).T
        return network_inputs(*low), network_inputs(*high)


# Grid of model errors, relative errors of a and of b: 0.5 to 32 %.
MODEL_ERRORS = tuple(0.005 * 2 ** (k / 2) for k in range(13))
# Width of the half-normal prior of a model error: such networks leave a few per cent. It is needed
# because smooth data hardly distinguish a curved network from a flat one with a large model error.
MODEL_ERROR_PRIOR = 0.05


class Discrepancy(NamedTuple):
    """Model error of a network: a smooth random error of ln a and ln b.

    Attributes
    ----------
    size : (float, float)
        Standard deviation of ln a and of ln b about the network.
    inputs : array, shape (n, k)
        Network inputs of the decays.
    length : array, shape (k,)
        Correlation lengths of the inputs.
    rows : array, shape (2n, 2n)
        Slopes of the pulls of the decays by ln a and ln b of each decay.
    """

    size: tuple[float, float]
    inputs: np.ndarray
    length: np.ndarray
    rows: np.ndarray

    def kernel(self, inputs: np.ndarray) -> np.ndarray:
        """Covariance of ln a and ln b at inputs (m, k) with those at the decays, (2m, 2n)."""
        distance = (inputs[:, None] - self.inputs) / self.length
        return np.kron(np.exp(-0.5 * np.sum(distance**2, -1)), np.diag(np.square(self.size)))

    @property
    def root(self) -> np.ndarray:
        """Cholesky factor of the covariance of the pulls with model error, (2n, 2n)."""
        covariance = self.rows @ self.kernel(self.inputs) @ self.rows.T
        return cholesky(np.eye(len(covariance)) + covariance, lower=True)

    def spread(
        self, at: np.ndarray, slopes: np.ndarray, residuals: np.ndarray, fit: Fit
    ) -> tuple[np.ndarray, np.ndarray]:
        """Model error of ln a and ln b at inputs (m, k): mean (2m,) and covariance (2m, 2m).

        `slopes`, (2m, p), are those of ln a and ln b by the free parameters of the network;
        `residuals`, (2n,), are the pulls of the decays. The covariance includes that of the
        parameters.
        """
        root = self.root
        gain = cho_solve((root, True), self.rows @ self.kernel(at).T)
        jacobian = root @ fit.dense_jacobian[: residuals.size]
        net_slopes = slopes - gain.T @ jacobian
        prior_covariance = self._replace(inputs=at).kernel(at)
        covariance = prior_covariance - gain.T @ self.rows @ self.kernel(at).T
        return gain.T @ residuals, covariance + net_slopes @ fit.covariance_raw @ net_slopes.T


def estimate_model_error(trial: Discrepancy, fit: Fit, residuals: np.ndarray) -> Discrepancy:
    """Estimate the model error: maximum of restricted likelihood times prior.

    The network's weights are integrated out in linear approximation about a fit with a trial size;
    `residuals` are the pulls of the decays.
    """
    free = [k for k, variable in enumerate(fit.variables) if variable.state == "free"]
    jacobian = fit.dense_jacobian[:, free]
    data_slopes, prior_slopes = trial.root @ jacobian[: residuals.size], jacobian[residuals.size :]
    start = fit.theta[free]

    def likelihood(size: tuple[float, float]) -> float:
        root = trial._replace(size=size).root
        rows = solve_triangular(root, data_slopes, lower=True)
        white = solve_triangular(root, residuals, lower=True)
        # Priors are normal about zero, so their residuals are their rows times the weights.
        information = rows.T @ rows + prior_slopes.T @ prior_slopes
        score = rows.T @ white - prior_slopes.T @ (prior_slopes @ start)
        chi2 = white @ white - score @ np.linalg.solve(information, score)
        return -np.log(np.diag(root)).sum() - 0.5 * (np.linalg.slogdet(information)[1] + chi2)

    def posterior(size: tuple[float, float]) -> float:
        return likelihood(size) - 0.5 * float(np.sum(np.square(size))) / MODEL_ERROR_PRIOR**2

    return trial._replace(size=max(itertools.product(MODEL_ERRORS, MODEL_ERRORS), key=posterior))


# Units of a, b and the lifetime.
LOSS_UNITS = ("1/(mA s)", "1/s", "h")
# Scale of the outputs: correction of ln a and ln b by weights of one, the standard deviation of
# their prior.
CORRECTION = 0.3
# Largest weight: ten standard deviations of the prior.
MAX_WEIGHT = 10.0
# Smallest half range by which an input is scaled, 0.1 MV or 10 %: a setting that hardly moves
# determines nothing.
MIN_INPUT_SCALE = 0.1
# Correlation length of the model error, in half ranges: chosen on simulated shifts.
CORRELATION_LENGTH = 0.8
# Number of RF voltages in a search for the maximum of the lifetime: chosen, 1/64 of the range.
N_VOLTAGES = 65


@shown
@dataclass(frozen=True, eq=False)
class NetworkFit:
    """Fitted network that corrects first principles.

    Parameters
    ----------
    fit : Fit
        Grey-box fit, with status, message and covariance.
    certificate : GainCertificate
        Enclosures of the slopes of the network's ln a and ln b by the four inputs (RF voltage in
        MV, logarithms of scraper in mm, pressure in nPa, and bunches) over the operating box.
    single_maximum : bool
        Whether the lifetime has a single maximum in the RF voltage, tested at points along the
        edges of the box: for first principles there is no enclosure.
    corrected : ScaleFit
        First principles that the network corrects.
    discrepancy : Discrepancy
        Model error.
    residuals : array, shape (2n,)
        Residuals of the decays in standard errors.
    """

    fit: Fit
    certificate: GainCertificate
    single_maximum: bool
    corrected: ScaleFit
    discrepancy: Discrepancy
    residuals: np.ndarray

    @property
    def usual(self) -> Operation:
        """Usual settings and vacuum of the machine."""
        return self.corrected.machine.operation

    def predict(self, operation: Operation, current: float) -> tuple[Quantity, ...]:
        """Predict a, b and the lifetime at a setting.

        Parameters
        ----------
        operation : Operation
            Settings and vacuum, with the P1/P0 of the ring file; the fit has a scale on it.
        current : float
            Mean current, mA.

        Returns
        -------
        tuple of Quantity
            a, 1/(mA s), b, 1/s, and the lifetime, h. Outside the operating box the errors are None:
            the prediction is an extrapolation.
        """
        inputs = _inputs(operation, current)[None]
        log_losses = np.log(np.array(self.corrected.losses_at(operation, current), float))
        logs = self.fit.derive(_logs, (inputs, log_losses[None]))
        mean, covariance = self.discrepancy.spread(inputs, logs.slope[0], self.residuals, self.fit)
        a, b = np.exp(logs.value[0])
        rate = a * current + b
        # Slopes of ln a, ln b and the logarithm of the lifetime by ln a and ln b.
        rows = np.array([[1, 0], [0, 1], [-a * current / rate, -b / rate]])
        spread = np.sum(rows @ covariance * rows, axis=1) + (rows @ mean) ** 2
        in_box = self.certificate.holds_at(inputs[0])
        named = zip((a, b, 1 / rate / HOUR), np.sqrt(spread), LOSS_UNITS, strict=True)
        return tuple(Quantity(float(v), float(e * v) if in_box else None, u) for v, e, u in named)

    def rows(self, current: float) -> list[Row]:
        """Table rows: predictions at a current, model error and certified properties."""
        certificate, model_error = self.certificate, self.discrepancy.size
        at = f"at the usual settings, {current:.4g} mA"
        names = (f"a {at}", f"b {at}", f"lifetime {at}")
        numbers = zip(names, self.predict(self.usual, current), strict=True)
        rows = [
            ("status", self.fit.status),
            ("chi2/dof", f"{self.fit.chi2:.4g}/{self.fit.dof}"),
            ("what it may be wrong by, a and b", " and ".join(map(percent, model_error))),
            *numbers,
            ("falls with scraper and bunches, rises with pressure", certificate.holds),
            ("single maximum of the lifetime in the RF voltage", self.single_maximum),
        ]
        return [Row(label, [value], quoted=True) for label, value in rows]

    def to_json(self, current: float) -> dict[str, Any]:
        """Verdict, and a, b and lifetime at the usual settings, as JSON's types."""
        found = {name: getattr(self.fit, name) for name in ("status", "message", "chi2", "dof")}
        a, b, lifetime = self.predict(self.usual, current)
        predicted = {"a": a, "b": b, "lifetime": lifetime, "certificate": self.certificate}
        predicted["single_maximum"] = self.single_maximum
        predicted["model_error"] = dict(zip("ab", self.discrepancy.size, strict=True))
        return json_of(found | predicted)


# Inputs of the network, ln a and ln b of first principles, mean currents, whitening matrix.
Data = tuple[Array, Array, Array, Array]


def _inputs(operation: Operation, current: float) -> np.ndarray:
    """Network inputs at a setting; logarithms where the losses go as powers."""
    pressure = operation.pressure_base + operation.pressure_slope * current
    return network_inputs(operation.rf_voltage, operation.scraper_y, pressure, operation.bunches)


def _logs(model: Mapping[str, MLP], data: tuple[Array, Array]) -> Array:
    """ln a and ln b at settings, shape (n, 2)."""
    inputs, base = data
    return base + jax.vmap(model["map"].values)(inputs)


def _predict(model: Mapping[str, MLP], data: Data) -> Array:
    *at, current, weight = data
    a, b = jnp.exp(_logs(model, at)).T
    return weight @ loss_parts(a, b, current).ravel()


def fit_loss_network(
    decays: Sequence[Decay],
    corrected: ScaleFit,
    *,
    hidden: int = 4,
    box: Box | None = None,
    starts: int = 3,
    seed: int = 0,
) -> NetworkFit:
    """Fit a network that multiplies a and b of first principles to decays at different settings.

    Parameters
    ----------
    decays : sequence of Decay
        Fitted decays whose records carry their settings.
    corrected : ScaleFit
        First principles fitted to the decays: a = a_fp exp(network), and likewise b.
    hidden : int, optional
        Number of nodes of the network.
    box : Box, optional
        Operating box of the certificate, outside which predictions have no error; default: the
        range of the decays. In a wider box errors are those of an extrapolation.
    starts, seed : int, optional
        Number of starts of the search, and seed of the random numbers.

    Returns
    -------
    NetworkFit
        Network with a certificate of its signs over the box.

    Raises
    ------
    InputError
        If there are fewer than four decays, a scraper is infinitely far away, or the box is empty.

    Notes
    -----
    A normal prior regularises the weights: where the data show no correction it stays zero. The
    model error is a smooth random error in the likelihood (M. C. Kennedy and A. O'Hagan, J. R.
    Stat. Soc. B 63 (2001) 425), whose size is estimated from the decays (`discrepancy`). Errors of
    predictions contain it, and grow away from the decays.
    """
    if len(decays) < 4:
        raise InputError(f"{len(decays)} decays", "4 or more at different settings")
    settings = settings_of(decays, corrected.machine)
    inputs = np.stack([_inputs(*setting) for setting in settings])
    if not np.isfinite(inputs).all():
        raise InputError("a setting that is not finite", "RF voltage, scraper, pressure, bunches")
    half = np.maximum(np.ptp(inputs, axis=0) / 2, MIN_INPUT_SCALE)
    low, high = (inputs.min(0), inputs.max(0)) if box is None else box.corners()
    entries = zip(INPUTS, half, inputs.mean(0), low, high, strict=True)
    ports = [Port(name, "", 0, *scale) for name, *scale in entries]
    outputs = [Port(name, "", scale=CORRECTION) for name in OUTPUTS]
    net, free = signed_network("map", ports, outputs, RISING, hidden, seed, MAX_WEIGHT)
    terms, measured = corrected.decays.terms, corrected.decays.measured
    weight, _, _, change = corrected.linearise(corrected.decays)
    losses = np.array(scaled_losses(jnp.asarray(corrected.vector), terms), float)
    base, whitening = jnp.log(losses.T), block_diag(*weight)
    target = whitening @ np.asarray(measured.parts).ravel()

    def fit_with(discrepancy: Discrepancy) -> tuple[Fit, np.ndarray]:
        whiten = np.linalg.inv(discrepancy.root)
        data = (jnp.asarray(inputs), base, measured.current, jnp.asarray(whiten @ whitening))
        problem = Problem(
            model={"map": net},
            free=free,
            records=[Record("decays", _predict, data, jnp.asarray(whiten @ target), error=1.0)],
            priors=[Prior("map", 0.0, 1.0)],
        )
        fit = solve(problem, starts=starts, seed=seed, iterations=300)
        return fit, target - np.asarray(_predict(fit.model, (*data[:3], jnp.asarray(whitening))))

    middle = MODEL_ERRORS[len(MODEL_ERRORS) // 2]
    trial = Discrepancy((middle, middle), inputs, CORRELATION_LENGTH * half, block_diag(*change))
    discrepancy = estimate_model_error(trial, *fit_with(trial))
    fit, residuals = fit_with(discrepancy)
    certificate = certificate_of(fit.problem, fit.model["map"])
    single = _single_maximum(fit, corrected, low, high, float(measured.current.max()))
    return NetworkFit(fit, certificate, single, corrected, discrepancy, residuals)


def _single_maximum(
    fit: Fit, corrected: ScaleFit, low: np.ndarray, high: np.ndarray, current: float
) -> bool:
    """Search for maxima along the voltage at every corner of the other settings."""
    corners = itertools.product(*zip(low[1:], high[1:], strict=True))
    voltages, scales = np.linspace(low[0], high[0], N_VOLTAGES), corrected.vector
    true = 1e6 * voltages * (1.0 if corrected.voltages is None else scales[len(SCALES)])
    for scraper, pressure, bunches in corners:
        operation = corrected.machine.operation._replace(
            scraper_y=1e-3 * np.exp(scraper),
            pressure_base=1e-9 * np.exp(pressure),
            pressure_slope=0.0,
            bunches=np.exp(bunches),
        )
        terms = terms_at_voltages(corrected.machine.ring, operation, current, true)
        base = jnp.log(jnp.stack(scaled_losses(scales, terms), axis=1))
        others = np.tile([scraper, pressure, bunches], (N_VOLTAGES, 1))
        inputs = jnp.asarray(np.column_stack([voltages, others]))
        a, b = np.exp(np.asarray(_logs(fit.model, (inputs, base)))).T
        extrema = np.diff(np.sign(np.diff(a * current + b)))
        if np.count_nonzero(extrema) > 1 or extrema.min(initial=0) < 0:
            return False
    return True
