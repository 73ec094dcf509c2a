"""Solution of a document: starts, solver options, and the result."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from beamfit.answer import Table, answer, cell
from beamfit.errors import Status
from beamfit.greybox.assess import slopes
from beamfit.greybox.diagnosis import diagnose
from beamfit.greybox.fit import Fit, FittedConstraint, FittedVariable
from beamfit.greybox.problem import TOLERANCE
from beamfit.greybox.solve import solve
from beamfit.language import document as d
from beamfit.language.compiled import gain_tables, gains_at, limit_rows, outputs_at
from beamfit.language.problem import Formulation, formulate, starts_of
from beamfit.language.trace import cause_of
from beamfit.quantity import Quantity
from beamfit.statistics import reach_of

# Solver options of documents, with the argument of `solve` that each sets.
SOLVER_OPTIONS = dict.fromkeys(("major iterations limit", "iterations limit"), "iterations")
SOLVER_OPTIONS["time limit"] = "seconds"
NOISE = "Errors treat squared terms as data residuals, with the noise inferred from their scatter."
# Kinds of defects that are reported elsewhere with their place in the document.
REPORTED_ELSEWHERE = {"contradictory_bounds", "not_finite", "unused"}
TOLERANCES = {"major feasibility tolerance", "major optimality tolerance"}


@answer
@dataclass(frozen=True, eq=False)
class ProblemSolution:
    """Solution of a document, with the names of the document.

    Parameters
    ----------
    name : str
        The objective that is minimised or maximised.
    fit : Fit
        Result of the solver.
    outputs, gains : mapping of str to array
        Outputs and requested derivatives at the answer.
    notes : tuple of str
        Remarks on the document, its starts and its solver parameters.
    made : Formulation
        The document and its problem.
    """

    name: str
    fit: Fit
    outputs: Mapping[str, np.ndarray]
    gains: Mapping[str, np.ndarray]
    notes: tuple[str, ...]
    made: Formulation

    @property
    def status(self) -> Status:
        """Verdict on the answer."""
        return self.fit.status

    @property
    def message(self) -> str:
        """Sentence of the verdict."""
        return self.fit.message

    @property
    def objective(self) -> float:
        """Value of the document's objective."""
        return self.made.factor * self.fit.cost

    @property
    def solver(self) -> str:
        """Solvers used from the start that led to the answer."""
        used = [a.solver for a in self.fit.attempts if np.array_equal(a.theta, self.fit.theta)]
        return (used or [a.solver for a in self.fit.attempts] or ["none"])[0]

    def variables(self) -> list[FittedVariable]:
        """Return the free numbers by their labels, with d(objective)/d(bound)."""
        return [
            v._replace(reduced_gradient=self.made.factor * v.reduced_gradient)
            for v in self.fit.variables
        ]

    def constraints(self) -> list[FittedConstraint]:
        """Return the limited outputs by their labels, with d(objective)/d(limit)."""
        return [
            c._replace(multiplier=self.made.factor * c.multiplier) for c in self.fit.constraints
        ]

    def quantity(self, v: FittedVariable) -> Quantity:
        """Return a free number with its error, and its interval from Student's t distribution."""
        if not math.isfinite(v.error):
            return Quantity(v.value, None, "1")
        reach = reach_of(self.fit.dof) * v.error if self.fit.dof > 0 else math.inf
        return Quantity.reaching(v.value, v.error, "1", v.error_raw, reach)

    @property
    def headline(self) -> str:
        """Objective and status in a line."""
        return f"{self.name} = {self.objective:.10g}, {cell(self.status)}"

    def tables(self) -> list[Table]:
        """Make tables of the objective, variables, constraints and outputs."""
        tables = [_table("variable", self.variables(), "reduced gradient", self.made.squares)]
        if self.fit.constraints:
            tables.append(_table("constraint", self.constraints(), "multiplier", False))
        values = [[n, f"{v:.8g}" if v.ndim == 0 else _range(v)] for n, v in self.outputs.items()]
        tables += [Table("", ["output", "value"], values, numeric=True)] if values else []
        return tables + gain_tables(self.made.program.scope, self.gains)

    def _variable(self, v: FittedVariable) -> dict[str, Any]:
        kept = ("name", "lower", "upper", "state", "reduced_gradient")
        return {key: getattr(v, key) for key in kept} | {"value": self.quantity(v)}

    def to_json(self) -> dict[str, Any]:
        """Return the result of the JSON contract."""
        return {
            "name": self.name,
            "status": self.status,
            "message": self.message,
            "objective": self.objective,
            "direction": "maximize" if self.made.factor < 0 else "minimize",
            "least_squares": self.made.squares,
            "dof": self.fit.dof,
            "solver": self.solver,
            "kkt_residual": self.fit.kkt.worst,
            "variables": [self._variable(v) for v in self.variables()],
            "constraints": self.constraints(),
            "outputs": self.outputs,
            "gains": self.gains,
            "starts": [
                {"objective": self.made.factor * a.cost, "solver": a.solver, "said": a.said}
                for a in self.fit.attempts
            ],
            "notes": self.notes,
        }


def _objective_name(document: d.Document) -> str:
    goals = document.problem.goals
    return " + ".join(g.label if g.weight == 1 else f"{g.weight:g} {g.label}" for g in goals)


def _range(values: np.ndarray) -> str:
    return f"{values.size} from {np.min(values):.5g} to {np.max(values):.5g}"


def _table(name: str, rows: Sequence, last: str, errors: bool) -> Table:
    header = [name, "value", *["error"] * errors, "lower", "upper", "state", last]
    return limit_rows(header, [_cells(row, errors) for row in rows])


def _cells(row: FittedVariable | FittedConstraint, errors: bool) -> list[str]:
    error = ["-" if not math.isfinite(row.error) else f"{row.error:.2g}"] if errors else []
    ends = [f"{end:.6g}" for end in (row.lower, row.upper)]
    return [row.name, f"{row.value:.8g}", *error, *ends, row.state, f"{row[-1] + 0.0:.3g}"]


# ---- solving


def solve_document(
    document: d.Document,
    tables: Mapping[str, np.ndarray] | None = None,
    starts: int = 1,
    values: Mapping[str, Sequence[float]] | None = None,
    gains: Iterable[str] = (),
    **options: Any,
) -> ProblemSolution:
    """Solve the problem of a document.

    Parameters
    ----------
    document : Document
        A document with a problem.
    tables : mapping of str to array, optional
        Its data tables by name.
    starts : int
        Number of searches. The first starts from the numbers that the document gives or draws with
        its seeds, the others from numbers drawn within the random ranges or the bounds.
    values : mapping of str to sequence of float, optional
        Values of inputs, and starts of variables, that replace the document's.
    gains : iterable of str, optional
        Derivatives to compute at the answer, written ``dy/dx``.
    **options
        `solver`, `seconds` and `iterations` of `beamfit.greybox.solve.solve`, and `tolerance` of
        the problem, which replace the document's solver parameters unless they are None.

    Returns
    -------
    ProblemSolution
        A search that fails raises nothing: the status states it.

    Raises
    ------
    InputError
        With its place, for an error in the document.

    Examples
    --------
    >>> from beamfit.language.parse import parse_document
    >>> text = '''maximize y; variable x in [0, 1] random [0, 1] seed 3;
    ...   input x; output y; y = x*(2 - x);'''
    >>> found = solve_document(parse_document(text))
    >>> print(found.headline, found.variables()[0].state)
    y = 1, optimal upper
    """
    began = time.perf_counter()
    options_used, warnings = _solve_options(document.solver)
    options_used |= {name: value for name, value in options.items() if value is not None}
    tolerance = options_used.pop("tolerance", TOLERANCE)
    made, notes = _with_finite_start(formulate(document, tables, values, tolerance))
    fit = solve(made.problem, starts=starts, began=began, **options_used)
    notes = (*made.notes, *notes, *_defects(made, fit), *warnings)
    if places := _places(made, fit.about):
        notes = (*notes, f"The verdict is about {places}.")
    if fit.status is Status.not_finite:
        cause = _cause(made, fit.model)
        options_used = cause is None or any(cause in note for note in notes)
        notes = notes if options_used else (*notes, f"Where it ended, {cause}.")
    if made.squares and math.isfinite(fit.scale):
        notes = (*notes, NOISE)
    outputs, gained = outputs_at(made.program, fit.model), gains_at(made.program, fit.model, gains)
    name = _objective_name(made.document)
    return ProblemSolution(name, fit, outputs, gained, notes, made)


def _with_finite_start(made: Formulation) -> tuple[Formulation, tuple[str, ...]]:
    """Find a start with finite values, drawn again with the same seeds if necessary."""
    p, variables = made.problem, made.document.problem.variables
    if slopes(p, p.start).finite:
        return made, ()
    cause = _cause(made, p.core.model)
    drawn = any(v.random for v in variables)
    for draws, model in enumerate(islice(starts_of(made), 1, 100 if drawn else 1), 1):
        if slopes(p, np.concatenate([np.ravel(model[v.model]) for v in variables])).finite:
            times = "once" if draws == 1 else f"{draws} times"
            start_text = f"At the start of the seeds {cause}"
            moved = replace(made, problem=replace(made.problem, model=model))
            return moved, (f"{start_text}; drawn again from the same seeds, {times}.",)
    return made, (f"At the start {cause}.",) if cause else ()


def _cause(made: Formulation, model: Mapping[str, np.ndarray]) -> str | None:
    """Find the cause of an objective, limit or derivative that is not finite."""
    problem = made.document.problem
    names = [one.model for one in (*problem.goals, *problem.limits)]
    found = cause_of(made.program, model, names)
    return found or cause_of(made.program, model, names, slopes=True)


def _defects(made: Formulation, fit: Fit) -> list[str]:
    """List the errors that `diagnose` finds, except those reported elsewhere with their place."""
    # If the verdict names a freedom of the model, more data would be a wrong remedy.
    named = set(fit.about) if fit.status is Status.unidentified else set()
    found = (one for one in diagnose(made.problem) if one.kind not in REPORTED_ELSEWHERE)
    new = (one for one in found if one.kind != "undetermined" or not named.issuperset(one.names))
    return [f"{one.message[:-1]} ({_places(made, one.names)})." for one in new]


def _places(made: Formulation, names: Iterable[str]) -> str:
    """Write the places in the document of numbers and limits; empty if there are none."""
    problem = made.document.problem
    labels = {one.label: one.at for one in (*problem.variables, *problem.limits)}
    labels_named = dict.fromkeys(name.partition("[")[0] for name in names)
    return ", ".join(f"'{name}' at {labels[name]}" for name in labels_named if name in labels)


def _solve_options(solver: d.Solver | None) -> tuple[dict[str, Any], list[str]]:
    """Convert solver parameters to options of `solve`, with a remark on ignored ones."""
    options: dict[str, Any] = {}
    unused, tight = [], []
    for name, value in solver.settings if solver else ():
        key = " ".join(name.lower().split())
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if key in SOLVER_OPTIONS and number > 0:
            options[SOLVER_OPTIONS[key]] = (
                int(number) if SOLVER_OPTIONS[key] == "iterations" else number
            )
        elif key in TOLERANCES and number > 0:
            tight.append(number)
        else:
            unused.append(name)
    notes = [f"Ignored solver options: {', '.join(unused)}."] if unused else []
    if tight:
        options["tolerance"] = min(tight)
    return options, notes
