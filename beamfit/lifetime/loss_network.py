"""A network that corrects first principles: ln a and ln b at any setting (report 3.4.2).

Signs of its weights make a and b fall with bunches and scraper opening and rise with pressure, at
every point and not only at data; first principles do so themselves, and so does the product.
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

INPUTS = ("rf_voltage", "scraper_y", "pressure", "bunches")
# How the loss moves with each input; nothing is known of the sign for the RF voltage.
SIGNS = {"scraper_y": -1, "pressure": 1, "bunches": -1}
OUTPUTS = ("log_a", "log_b")
RISING = np.array([[SIGNS.get(name, 0) for name in INPUTS]] * len(OUTPUTS))


def scaled(rf_voltage: float, scraper_y: float, pressure: float, bunches: float) -> np.ndarray:
    """Inputs of a network from V, m, Pa, number: MV, logarithms of mm, nPa and number."""
    values = np.array([1e3 * scraper_y, 1e9 * pressure, bunches], float)
    return np.array([1e-6 * float(rf_voltage), *np.log(values)])


class Box(NamedTuple):
    """A range of operation, the ends in SI: what a network is asked to hold over.

    Parameters
    ----------
    rf_voltage, scraper_y, pressure, bunches : (float, float)
        V, m, Pa at the mean current, and number.

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
        """Both corners in the network's inputs."""
        for name, (low, high) in zip(self._fields, self, strict=True):
            if not 0 < low <= high < np.inf:
                expected = "0 < lower <= upper, finite"
                raise InputError(f"range {low:g} to {high:g}", expected, column=name)
        low, high = np.array(self, float).T
        return scaled(*low), scaled(*high)


# Sizes that are weighed, as relative errors of a and of b.
SIZES = tuple(0.005 * 2 ** (k / 2) for k in range(13))
# Prior of a size: half a normal of this width. Smooth decays tell a network that bends hardly from
# a flat one with a large error, and what a network of losses leaves is a few per cent.
USUAL = 0.05


class Discrepancy(NamedTuple):
    """Smooth errors of a model of decays.

    Attributes
    ----------
    size : (float, float)
        Standard deviation of ln a and of ln b about the network.
    inputs : array, shape (n, k)
        Of the decays.
    length : array, shape (k,)
        Correlation lengths.
    rows : array, shape (2n, 2n)
        Slopes of what the decays say, in their errors, by ln a and ln b of each decay.
    """

    size: tuple[float, float]
    inputs: np.ndarray
    length: np.ndarray
    rows: np.ndarray

    def kernel(self, at: np.ndarray) -> np.ndarray:
        """Covariance of (ln a, ln b) at inputs (m, k) with those at the decays, (2m, 2n)."""
        off = (at[:, None] - self.inputs) / self.length
        return np.kron(np.exp(-0.5 * np.sum(off**2, -1)), np.diag(np.square(self.size)))

    @property
    def root(self) -> np.ndarray:
        """Lower triangle of the covariance of the decays, in their own errors, (2n, 2n)."""
        covariance = self.rows @ self.kernel(self.inputs) @ self.rows.T
        return cholesky(np.eye(len(covariance)) + covariance, lower=True)

    def spread(
        self, at: np.ndarray, slopes: np.ndarray, left: np.ndarray, fit: Fit
    ) -> tuple[np.ndarray, np.ndarray]:
        """Model error of the network at inputs (m, k): mean (2m,), covariance (2m, 2m).

        `slopes` of ln a and ln b by the network's free numbers, (2m, p); `left` of the decays'
        residuals, in their errors, (2n,). Weights and errors of the model are not told apart.
        """
        root = self.root
        reach = cho_solve((root, True), self.rows @ self.kernel(at).T)
        jacobian = root @ fit.dense_jacobian[: left.size]
        total = slopes - reach.T @ jacobian
        own = self._replace(inputs=at).kernel(at)
        rest = own - reach.T @ self.rows @ self.kernel(at).T
        return reach.T @ left, rest + total @ fit.covariance_raw @ total.T


def sized(trial: Discrepancy, fit: Fit, left: np.ndarray) -> Discrepancy:
    """The size by restricted likelihood and its prior: weights integrated out about a fit made with
    a trial size.

    `left` are the decays' residuals, in their errors.
    """
    free = [k for k, variable in enumerate(fit.variables) if variable.state == "free"]
    jacobian = fit.dense_jacobian[:, free]
    seen, known = trial.root @ jacobian[: left.size], jacobian[left.size :]
    start = fit.theta[free]

    def likelihood(size: tuple[float, float]) -> float:
        root = trial._replace(size=size).root
        rows = solve_triangular(root, seen, lower=True)
        off = solve_triangular(root, left, lower=True)
        # Priors are normal about zero: their residuals are their rows times the weights.
        information = rows.T @ rows + known.T @ known
        pull = rows.T @ off - known.T @ (known @ start)
        rest = off @ off - pull @ np.linalg.solve(information, pull)
        return -np.log(np.diag(root)).sum() - 0.5 * (np.linalg.slogdet(information)[1] + rest)

    def posterior(size: tuple[float, float]) -> float:
        return likelihood(size) - 0.5 * float(np.sum(np.square(size))) / USUAL**2

    return trial._replace(size=max(itertools.product(SIZES, SIZES), key=posterior))


# Units of a, b and the lifetime.
LOSSES = ("1/(mA s)", "1/s", "h")
# Size of a correction of ln a and ln b by weights of one, the standard deviation of the prior on
# them, which is the usual for inputs and outputs of size one; none exceeds ten.
CORRECTION, MOST = 0.3, 10.0
# An input counts by half its range, 0.1 MV or 10 % at least: what hardly moved tells nothing. The
# model's error is correlated over so much of that, chosen on simulated shifts.
SHORTEST, LENGTH = 0.1, 0.8
# Voltages that are looked at, for a maximum or for the longest lifetime.
N_VOLTAGES = 65


@shown
@dataclass(frozen=True, eq=False)
class NetworkFit:
    """A fitted network of losses.

    Parameters
    ----------
    fit : Fit
        Of the grey-box core, with its status, message and covariance.
    certificate : GainCertificate
        Enclosures of the slopes of the network's ln a and ln b by the four inputs, which are RF
        voltage MV, logarithms of scraper mm, pressure nPa and bunches; and the operating box.
    single_maximum : bool
        Whether the lifetime has a single maximum in the RF voltage at points along the edges of
        the box: first principles have no enclosure.
    corrected : ScaleFit
        The first principles that the network corrects.
    discrepancy : Discrepancy
        What it may be wrong by.
    left : array, shape (2n,)
        What it leaves of the decays, in their errors.
    """

    fit: Fit
    certificate: GainCertificate
    single_maximum: bool
    corrected: ScaleFit
    discrepancy: Discrepancy
    left: np.ndarray

    @property
    def usual(self) -> Operation:
        """The machine's usual settings and vacuum."""
        return self.corrected.machine.operation

    def predict(self, operation: Operation, current: float) -> tuple[Quantity, ...]:
        """Predict a, b and the lifetime at a setting.

        Parameters
        ----------
        operation : Operation
            Settings and vacuum, with the P1/P0 of the ring file, which a scale is on.
        current : float
            Mean current, mA.

        Returns
        -------
        tuple of Quantity
            a, 1/(mA s), b, 1/s, and the lifetime, h. Outside the operating box the network is not
            to be believed, and the errors are None.
        """
        at = _inputs(operation, current)[None]
        base = np.log(np.array(self.corrected.losses_at(operation, current), float))
        logs = self.fit.derive(_logs, (at, base[None]))
        mean, covariance = self.discrepancy.spread(at, logs.slope[0], self.left, self.fit)
        a, b = np.exp(logs.value[0])
        rate = a * current + b
        # By ln a and ln b: of themselves, and of the logarithm of the lifetime.
        rows = np.array([[1, 0], [0, 1], [-a * current / rate, -b / rate]])
        spread = np.sum(rows @ covariance * rows, axis=1) + (rows @ mean) ** 2
        inside = self.certificate.holds_at(at[0])
        named = zip((a, b, 1 / rate / HOUR), np.sqrt(spread), LOSSES, strict=True)
        return tuple(Quantity(float(v), float(e * v) if inside else None, u) for v, e, u in named)

    def rows(self, current: float) -> list[Row]:
        """Label and value of what it says at a current, and of what it obeys."""
        held, wrong = self.certificate, self.discrepancy.size
        at = f"at the usual settings, {current:.4g} mA"
        names = (f"a {at}", f"b {at}", f"lifetime {at}")
        numbers = zip(names, self.predict(self.usual, current), strict=True)
        rows = [
            ("status", self.fit.status),
            ("chi2/dof", f"{self.fit.chi2:.4g}/{self.fit.dof}"),
            ("what it may be wrong by, a and b", " and ".join(map(percent, wrong))),
            *numbers,
            ("falls with scraper and bunches, rises with pressure", held.holds),
            ("single maximum of the lifetime in the RF voltage", self.single_maximum),
        ]
        return [Row(label, [value], quoted=True) for label, value in rows]

    def to_json(self, current: float) -> dict[str, Any]:
        """Return the verdict, and a, b and lifetime at the usual settings, as JSON's types."""
        found = {name: getattr(self.fit, name) for name in ("status", "message", "chi2", "dof")}
        a, b, lifetime = self.predict(self.usual, current)
        told = {"a": a, "b": b, "lifetime": lifetime, "certificate": self.certificate}
        told["single_maximum"] = self.single_maximum
        told["model_error"] = dict(zip("ab", self.discrepancy.size, strict=True))
        return json_of(found | told)


# The network's inputs, ln a and ln b of first principles, mean currents, weights of the two rates.
Data = tuple[Array, Array, Array, Array]


def _inputs(operation: Operation, current: float) -> np.ndarray:
    """Inputs in units near one; logarithms where the losses go as powers."""
    pressure = operation.pressure_base + operation.pressure_slope * current
    return scaled(operation.rf_voltage, operation.scraper_y, pressure, operation.bunches)


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
    """Fit a network that multiplies a and b of first principles, to decays at different settings.

    Parameters
    ----------
    decays : sequence of Decay
        Fitted decays whose records carry their settings.
    corrected : ScaleFit
        First principles fitted to them: a = a_fp exp(network), and b alike.
    hidden : int, optional
        Nodes of the network.
    box : Box, optional
        The operating box of the certificate, outside which nothing is predicted; what the decays
        span by default. Where it is wider than that, errors are those of an extrapolation.
    starts, seed : int, optional
        Of the search.

    Returns
    -------
    NetworkFit
        With a certificate of its signs over the box.

    Raises
    ------
    InputError
        If there are fewer than four decays, a scraper is infinitely far away, or the box is empty.

    Notes
    -----
    Weights are regularised by a normal prior of width 0.3, so that a correction the data do not ask
    for stays zero. What the network cannot follow is a smooth random error in its likelihood, whose
    size the decays themselves tell (`discrepancy`); errors of predictions contain it, and grow away
    from the decays.
    """
    if len(decays) < 4:
        raise InputError(f"{len(decays)} decays", "4 or more at different settings")
    settings = settings_of(decays, corrected.machine)
    inputs = np.stack([_inputs(*setting) for setting in settings])
    if not np.isfinite(inputs).all():
        raise InputError("a setting that is not finite", "RF voltage, scraper, pressure, bunches")
    half = np.maximum(np.ptp(inputs, axis=0) / 2, SHORTEST)
    low, high = (inputs.min(0), inputs.max(0)) if box is None else box.corners()
    entries = zip(INPUTS, half, inputs.mean(0), low, high, strict=True)
    ports = [Port(name, "", 0, *scale) for name, *scale in entries]
    outputs = [Port(name, "", scale=CORRECTION) for name in OUTPUTS]
    net, free = signed_network("map", ports, outputs, RISING, hidden, seed, MOST)
    terms, measured = corrected.decays.terms, corrected.decays.measured
    weight, _, _, change = corrected.linearise(corrected.decays)
    losses = np.array(scaled_losses(jnp.asarray(corrected.vector), terms), float)
    base, whole = jnp.log(losses.T), block_diag(*weight)
    seen = whole @ np.asarray(measured.parts).ravel()

    def fitted(wrong: Discrepancy) -> tuple[Fit, np.ndarray]:
        whiten = np.linalg.inv(wrong.root)
        data = (jnp.asarray(inputs), base, measured.current, jnp.asarray(whiten @ whole))
        problem = Problem(
            model={"map": net},
            free=free,
            records=[Record("decays", _predict, data, jnp.asarray(whiten @ seen), error=1.0)],
            priors=[Prior("map", 0.0, 1.0)],
        )
        fit = solve(problem, starts=starts, seed=seed, iterations=300)
        return fit, seen - np.asarray(_predict(fit.model, (*data[:3], jnp.asarray(whole))))

    middle = SIZES[len(SIZES) // 2]
    trial = Discrepancy((middle, middle), inputs, LENGTH * half, block_diag(*change))
    wrong = sized(trial, *fitted(trial))
    fit, left = fitted(wrong)
    held = certificate_of(fit.problem, fit.model["map"])
    single = _single_maximum(fit, corrected, low, high, float(measured.current.max()))
    return NetworkFit(fit, held, single, corrected, wrong, left)


def _single_maximum(
    fit: Fit, corrected: ScaleFit, low: np.ndarray, high: np.ndarray, current: float
) -> bool:
    """Look along the voltage at every corner of the other settings."""
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
        rest = np.tile([scraper, pressure, bunches], (N_VOLTAGES, 1))
        inputs = jnp.asarray(np.column_stack([voltages, rest]))
        a, b = np.exp(np.asarray(_logs(fit.model, (inputs, base)))).T
        turns = np.diff(np.sign(np.diff(a * current + b)))
        if np.count_nonzero(turns) > 1 or turns.min(initial=0) < 0:
            return False
    return True
