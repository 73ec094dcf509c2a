"""Result of a fit: values with errors, bounds and multipliers, and the verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import issparse

from beamfit.compile_cache import SELDOM
from beamfit.errors import Finding, InputError, Status, nearest
from beamfit.greybox import tree
from beamfit.greybox.assess import KKT
from beamfit.greybox.covariance import MOST_SHARE, FactoredSpread, Group, Spread
from beamfit.greybox.problem import Problem, with_slope
from beamfit.greybox.sparse import Rows

if TYPE_CHECKING:
    from beamfit.greybox.posterior import Optimum
    from beamfit.sampling.posterior import Posterior
    from beamfit.sampling.priors import Distribution

# Another optimum also starts the sampler if its cost exceeds the best by less than this: a
# difference of 6 in chi-square, which makes it 20 times less probable.
NEAR_COST = 3.0


class FittedVariable(NamedTuple):
    """A free number: value, error, bounds, state and reduced gradient d(cost)/d(bound).

    `error` is one standard deviation, NaN where the data do not determine the value. `error_raw` is
    the error without a factor on the given errors of the data (`Fit.covariance_raw`). `state` is
    ``free``, ``lower``, ``upper`` or ``fixed``.
    """

    name: str
    value: float
    error: float
    error_raw: float
    lower: float
    upper: float
    state: str
    reduced_gradient: float


class FittedConstraint(NamedTuple):
    """A constraint element: value, limits, state and multiplier d(cost)/d(limit)."""

    name: str
    value: float
    lower: float
    upper: float
    state: str
    multiplier: float


class Derived(NamedTuple):
    """Quantities computed from a fit, all of the shape of `value`.

    `share` is the share of the variance that comes from bounds, 1 for an undetermined quantity.
    `error` and `error_raw` are NaN where it is `MOST_SHARE` or more. `slope` has the derivatives by
    the free numbers along one more axis.
    """

    value: np.ndarray
    error: np.ndarray
    error_raw: np.ndarray
    share: np.ndarray
    slope: np.ndarray


@partial(jax.jit, static_argnums=(0, 1), compiler_options=SELDOM)
def _with_slope(function, chosen, model, theta, data):
    return with_slope(lambda t: function(tree.replace(model, chosen, t), data), theta)


def value_and_slope(
    p: Problem, function: Callable[[Any, Any], Any], theta: np.ndarray, data: Any = None
) -> tuple[np.ndarray, np.ndarray]:
    """Compute ``function(model, data)`` of a problem and its derivatives by the free numbers."""
    core = p.core
    value, slope = _with_slope(function, core.chosen, core.model, jnp.asarray(theta), data)
    return np.asarray(value), np.asarray(slope)


class Attempt(NamedTuple):
    """Search from one start: solvers, end point, cost, KKT residuals, iterations, message."""

    solver: str
    theta: np.ndarray
    cost: float
    kkt: KKT
    iterations: int
    said: str


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit, with its errors and verdict.

    Parameters
    ----------
    problem : Problem
        The problem that was solved.
    theta : array, shape (n,)
        The free numbers.
    status : Status
        The verdict.
    message : str
        One sentence: cause and remedy.
    cost, chi2 : float
        Cost, and sum of squared residuals, priors included.
    dof : int
        Number of residuals less that of the directions they determine.
    groups : tuple of Group
        The noise of each record.
    kkt : KKT
        KKT residuals of the answer, computed independently of the solver.
    variables, constraints : tuple
        The free numbers and the constraint elements, with bounds, states and multipliers.
    spread, spread_raw : Spread
        Errors in linear approximation along the active limits, with bounds as information. In
        `spread` each record's residuals are divided by the scale of its group; in `spread_raw` only
        where no errors were given.
    jacobian : array, shape (m, n)
        Derivatives of the residuals, in units of their errors, priors last; a sparse array for
        large sparse problems.
    undetermined : array, shape (n, k)
        Directions in theta that the residuals do not determine.
    scale : float
        sqrt(chi2/dof) of all residuals; at least 1 if any record has given errors.
    attempts : tuple of Attempt
        One for each start; the best one is the answer.
    seconds : float
        Time taken, compilation included.
    about : tuple of str
        Names of the numbers and constraints that the verdict is about.
    """

    problem: Problem
    theta: np.ndarray
    status: Status
    message: str
    cost: float
    chi2: float
    dof: int
    groups: tuple[Group, ...]
    kkt: KKT
    variables: tuple[FittedVariable, ...]
    constraints: tuple[FittedConstraint, ...]
    spread: Spread | FactoredSpread
    spread_raw: Spread | FactoredSpread
    jacobian: Rows
    undetermined: np.ndarray
    scale: float
    attempts: tuple[Attempt, ...]
    seconds: float
    about: tuple[str, ...] = ()

    @cached_property
    def model(self) -> Any:
        """The model with the fitted numbers."""
        return self.problem.model_at(self.theta)

    @property
    def dense_jacobian(self) -> np.ndarray:
        """The Jacobian as an array, shape (m, n); a copy."""
        return self.jacobian.toarray() if issparse(self.jacobian) else np.array(self.jacobian)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the free numbers, shape (n, n), zero along undetermined directions."""
        return self.spread.seen

    @property
    def covariance_raw(self) -> np.ndarray:
        """Covariance without a factor on the given errors of the data, shape (n, n)."""
        return self.spread_raw.seen

    def group(self, name: str) -> Group:
        """Return the noise of a record by its name."""
        known = {group.name: group for group in self.groups}
        if name not in known:
            raise InputError(f"no record '{name}'", nearest(name, list(known)))
        return known[name]

    @property
    def iterations(self) -> int:
        """Number of iterations over all starts."""
        return sum(attempt.iterations for attempt in self.attempts)

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the active bounds and constraints."""
        rows = (*self.variables, *self.constraints)
        return tuple(row.name for row in rows if row.state in ("lower", "upper"))

    @cached_property
    def _rows(self) -> dict[str, FittedVariable | FittedConstraint]:
        return {row.name: row for row in (*self.constraints, *self.variables)}

    def __getitem__(self, name: str) -> FittedVariable | FittedConstraint:
        """Return a free number or constraint element by its name."""
        if name not in self._rows:
            raise InputError(f"no result '{name}'", nearest(name, list(self._rows)))
        return self._rows[name]

    def derive(self, function: Callable[[Any, Any], Any], data: Any = None) -> Derived:
        """Compute quantities of the fitted model and their errors, in linear approximation.

        Parameters
        ----------
        function : callable
            ``function(model, data)``, an array of any shape, in JAX. Defined at the top of a
            module, it is compiled once for all fits of one structure.
        data : pytree, optional
            Second argument of the function.

        Returns
        -------
        Derived

        Examples
        --------
        >>> from beamfit.greybox.problem import Free, Problem, Record
        >>> from beamfit.greybox.solve import solve
        >>> def level(model, data):
        ...     return model["level"] + 0 * data
        >>> def double(model, data):
        ...     return 2 * model["level"]
        >>> record = Record("scan", level, np.zeros(4), [1.0, 1.2, 0.9, 0.9], error=0.2)
        >>> found = solve(Problem({"level": 0.0}, [Free("level")], [record])).derive(double)
        >>> round(float(found.value), 9), round(float(found.error), 9)
        (2.0, 0.2)
        """
        value, slope = value_and_slope(self.problem, function, self.theta, data)
        usable = np.isfinite(value) & np.isfinite(slope).all(axis=-1)
        flat = np.where(usable[..., None], slope, 0.0)
        share = np.where(usable, self.spread.share(flat), 1.0)
        known = (share < MOST_SHARE) & (not any(group.unknown for group in self.groups))
        errors = (
            np.where(known, part.error(flat), np.nan) for part in (self.spread, self.spread_raw)
        )
        return Derived(value, *errors, share, slope)

    def sample(
        self,
        *,
        noise: str | None = None,
        outliers: bool = False,
        priors: Mapping[str, Distribution] | None = None,
        **options: Any,
    ) -> Posterior:
        """Draw from the posterior of the free numbers, within all bounds and constraints.

        Parameters
        ----------
        noise : {"known", "inferred"}, optional
            ``known``: the given errors are right. ``inferred``: they are right up to a factor,
            which is inferred. By default, the noise of a record is inferred if it has no errors or
            the fit enlarged them.
        outliers : bool
            True to allow an unknown fraction of outliers among the points.
        priors : mapping of str to distribution, optional
            Further priors by the name of a free number: `Normal`, `LogNormal`, `Uniform`,
            `HalfNormal` of `beamfit.sampling.priors`, or a frozen distribution of scipy.stats.
        **options
            ``seed, target_ess, budget, walkers, store, provenance, progress`` of
            `beamfit.sampling.ensemble.draw`.

        Returns
        -------
        Posterior
            If neither data, priors nor bounds limit some numbers, its message names them and
            nothing is sampled.

        Raises
        ------
        InputError
            If an option is not understood, or a constraint is an equation.
        """
        from beamfit.greybox.posterior import target_of
        from beamfit.sampling.ensemble import draw

        noise_options = {"noise": noise, "outliers": outliers, "priors": priors}
        return draw(target_of(self.problem, self.optimum, **noise_options), **options)

    @property
    def optimum(self) -> Optimum:
        """This fit as a start for the sampler."""
        from beamfit.greybox.posterior import Optimum

        converged = [a for a in self.attempts if a.kkt.worst <= self.problem.tolerance]
        return Optimum(
            self.theta,
            Finding(self.status, self.message),
            [group.scale for group in self.groups],
            [group.errors_given for group in self.groups],
            self.undetermined,
            [a.theta for a in converged if a.cost - self.cost < NEAR_COST],
        )

    def __str__(self) -> str:
        """A table of the verdict, the numbers and the active constraints."""
        per = f", chi2/dof = {self.chi2 / self.dof:.3g}" if self.dof > 0 else ""
        fits = self.problem.has_data
        quality = (
            f"chi2 = {self.chi2:.6g}, dof = {self.dof}{per}" if fits else f"cost = {self.cost:.6g}"
        )
        lines = [f"{self.status}: {self.message}", f"{quality}, KKT = {self.kkt.worst:.1e}"]
        shown = [v for v, n in zip(self.variables, self.problem.nuisance, strict=True) if not n]
        width = max((len(row.name) for row in (*shown, *self.constraints)), default=4)
        for v in shown:
            error = "undetermined" if np.isnan(v.error) else f"{v.error:.2g}"
            error = f" ± {error:<12}" if fits else ""
            held = "" if v.state == "free" else f"  {v.state}, gradient {v.reduced_gradient:.3g}"
            lines.append(f"{v.name:<{width}}  {v.value:>13.6g}{error}{held}".rstrip())
        hidden = len(self.variables) - len(shown)
        lines += [f"and {hidden} nuisance numbers"] if hidden else []
        for c in self.constraints:
            if c.state in ("lower", "upper"):
                lines.append(
                    f"{c.name:<{width}}  {c.value:>13.6g} at its {c.state} limit, "
                    f"multiplier {c.multiplier:.3g}"
                )
        return "\n".join(lines)
