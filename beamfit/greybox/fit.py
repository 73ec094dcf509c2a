"""The answer of a fit: values, what they are worth, and what held them."""

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

# Cost above the best (half of a chi-square of 6) up to which another optimum starts the sampler.
NEAR_COST = 3.0


class FittedVariable(NamedTuple):
    """A free number: value, error, bounds, state and reduced gradient d(cost)/d(bound).

    `error` is one standard deviation, NaN where the data do not determine the value; `error_raw`
    takes errors that were given as they are (`Fit.covariance_raw`). `state` is ``free``,
    ``lower``, ``upper`` or ``fixed``.
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
    """Numbers computed from a fit, all of the shape of `value`.

    `error` and `error_raw` are NaN where the data do not determine the value: where `share`, the
    part of its variance that rests on bounds or on nothing, is `MOST_SHARE` or more. `slope` has
    the derivatives by the free numbers along one more axis.
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
    """``function(model, data)`` of a problem, with its derivatives by the free numbers."""
    core = p.core
    value, slope = _with_slope(function, core.chosen, core.model, jnp.asarray(theta), data)
    return np.asarray(value), np.asarray(slope)


class Attempt(NamedTuple):
    """One start of a search: which solver ended where, at what cost, how near to an optimum."""

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
        What was fitted.
    theta : array, shape (n,)
        The free numbers.
    status : Status
        The verdict.
    message : str
        One sentence: cause and remedy.
    cost, chi2 : float
        Cost, and sum of squared residuals, priors included.
    dof : int
        Residuals less the directions they determine.
    groups : tuple of Group
        The noise of each record.
    kkt : KKT
        How far from an optimum, computed here and not by a solver.
    variables, constraints : tuple
        The free numbers and the constraint elements, with bounds, states and multipliers.
    spread, spread_raw : Spread
        Errors in linear approximation along the active limits, bounds counted as information:
        each record's residuals divided by the scale of its group, or by 1 where errors were given.
    jacobian : array, shape (m, n)
        Derivatives of the residuals, in units of their errors, priors last; sparse where the
        problem is, of many numbers.
    undetermined : array, shape (n, k)
        Directions in theta that the residuals do not see.
    scale : float
        sqrt(chi2/dof) of all residuals where above 1, or wherever all noise is inferred.
    attempts : tuple of Attempt
        Every start; the best one is the answer.
    seconds : float
        Time taken, compilation included.
    about : tuple of str
        Names of the numbers and constraints that the verdict speaks of.
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
        """Covariance of the free numbers, shape (n, n), zero along open directions."""
        return self.spread.seen

    @property
    def covariance_raw(self) -> np.ndarray:
        """The same with errors that were given taken as they are."""
        return self.spread_raw.seen

    def group(self, name: str) -> Group:
        """The noise of the record of a name."""
        known = {group.name: group for group in self.groups}
        if name not in known:
            raise InputError(f"no record '{name}'", nearest(name, list(known)))
        return known[name]

    @property
    def iterations(self) -> int:
        """Iterations over all starts."""
        return sum(attempt.iterations for attempt in self.attempts)

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the bounds and constraints that hold the answer."""
        rows = (*self.variables, *self.constraints)
        return tuple(row.name for row in rows if row.state in ("lower", "upper"))

    @cached_property
    def _rows(self) -> dict[str, FittedVariable | FittedConstraint]:
        return {row.name: row for row in (*self.constraints, *self.variables)}

    def __getitem__(self, name: str) -> FittedVariable | FittedConstraint:
        """The free number or constraint element of a name."""
        if name not in self._rows:
            raise InputError(f"no result '{name}'", nearest(name, list(self._rows)))
        return self._rows[name]

    def derive(self, function: Callable[[Any, Any], Any], data: Any = None) -> Derived:
        """Compute quantities from the fitted model with their errors, in linear approximation.

        Parameters
        ----------
        function : callable
            ``function(model, data)``, an array of any shape, in JAX. Defined at the top of a
            module, it is compiled once for all fits of one structure.
        data : pytree, optional
            What it needs besides the model.

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
            Whether the errors are right, or right up to a common factor that is inferred. By
            default they are inferred where no record has any or the fit enlarged them.
        outliers : bool
            Let an unknown fraction of the points be outliers.
        priors : mapping of str to distribution, optional
            By name of a free number, besides the problem's own: `Normal`, `LogNormal`, `Uniform`,
            `HalfNormal` of `beamfit.sampling.priors`, or a frozen one of scipy.stats.
        **options
            ``seed, target_ess, budget, walkers, store, provenance, progress`` of
            `beamfit.sampling.ensemble.draw`.

        Returns
        -------
        Posterior
            A direction that nothing holds is named in its message, and nothing is sampled.

        Raises
        ------
        InputError
            If an option is not understood, or a constraint is an equation.
        """
        from beamfit.greybox.posterior import target_of
        from beamfit.sampling.ensemble import draw

        told = {"noise": noise, "outliers": outliers, "priors": priors}
        return draw(target_of(self.problem, self.optimum, **told), **options)

    @property
    def optimum(self) -> Optimum:
        """This fit as a start for the sampler."""
        from beamfit.greybox.posterior import Optimum

        near = [a for a in self.attempts if a.kkt.worst <= self.problem.tolerance]
        return Optimum(
            self.theta,
            Finding(self.status, self.message),
            [group.scale for group in self.groups],
            [group.errors_given for group in self.groups],
            self.undetermined,
            [a.theta for a in near if a.cost - self.cost < NEAR_COST],
        )

    def __str__(self) -> str:
        """A table of the verdict, the numbers and the active constraints."""
        per = f", chi2/dof = {self.chi2 / self.dof:.3g}" if self.dof > 0 else ""
        fits = self.problem.has_data
        worth = (
            f"chi2 = {self.chi2:.6g}, dof = {self.dof}{per}" if fits else f"cost = {self.cost:.6g}"
        )
        lines = [f"{self.status}: {self.message}", f"{worth}, KKT = {self.kkt.worst:.1e}"]
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
