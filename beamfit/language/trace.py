"""Search for the first part of a document's formulas that is not finite, with its place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import jax
import numpy as np

from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.compiled import Program, run_group
from beamfit.language.evaluate import Context, Value, evaluate
from beamfit.language.plan import RecurrencePlan, StepGroup, callee_of
from beamfit.language.scope import Axes, IndexSet, MappingStep, Scope, iterator_text
from beamfit.language.steps import Arrays, call_inputs


class _FoundError(Exception):
    """Raised at the first part that is not finite, to end the search."""


def cause_of(
    program: Program,
    inputs: Mapping[str, jax.Array],
    names: Iterable[str],
    inside: str = "",
    slopes: bool = False,
) -> str | None:
    """Explain why some outputs are not finite.

    Parameters
    ----------
    program : Program
        A compiled mapping.
    inputs : mapping of str to array
        Values of the inputs.
    names : iterable of str
        The outputs.
    inside : str
        Beginning of the message for an inner mapping.
    slopes : bool
        True to search for an infinite derivative, at a root or a fractional power of zero.

    Returns
    -------
    str or None
        The part of a formula with its place, index and numbers; None if all is finite.

    Examples
    --------
    >>> from beamfit.language.compiled import compile_mapping
    >>> from beamfit.language.parse import parse_document
    >>> text = "set K = |1:3|; input a; output y; y = sum(k in K | sqrt(a - k));"
    >>> cause_of(compile_mapping(parse_document(text).mapping), {"a": 2.5}, ["y"])
    'sqrt(a - k) is not a number for k = 3 (line 1, column 52): a - k = -0.5'
    """
    try:
        _search(program, inputs, names, slopes)
    except _FoundError as found:
        return f"{inside}{found}"
    return None


def _search(program: Program, inputs: Mapping, names: Iterable[str], slopes: bool) -> None:
    """Compute group after group, and search those with a value that is not finite."""
    arrays = program.begin(inputs)
    for name, value in arrays.items():
        if not np.all(np.isfinite(value)):
            raise _FoundError(f"{name} is not finite")
    for group in program.order.needed(names):
        changed = run_group(program.order, group, arrays)
        if slopes or not all(np.all(np.isfinite(array)) for array in changed.values()):
            _search_group(program, group, arrays, changed, slopes)
        arrays |= changed


class _Monitor:
    """Check every value that is computed, and keep all for the message."""

    def __init__(self, slopes: bool = False) -> None:
        self.values: dict[int, Value] = {}
        self.slopes = slopes

    def __call__(self, e: x.Expression, value: Value, axes: Axes) -> None:
        array = np.asarray(value.array)
        self.values[id(e)] = value
        steep = self.slopes and _may_be_steep(e)
        bad = ~np.isfinite(array) | (steep & (array == 0))
        if not bad.any():
            return
        at = np.argwhere(bad)[0][: len(axes)]
        problem = "infinite" if np.any(np.isinf(array)) else "not a number"
        problem = "zero and has an infinite derivative" if np.all(np.isfinite(array)) else problem
        message = f"{e} is {problem}{iterator_text(axes, at, array.shape, ' for ')} ({e.at})"
        inner = ", ".join(self._text_of(part, at) for part in x.children(e) if self._is_shown(part))
        raise _FoundError(message + (f": {inner}" if inner else ""))

    def _is_shown(self, part: x.Expression) -> bool:
        return id(part) in self.values and not isinstance(part, x.Literal)

    def _text_of(self, part: x.Expression, at: np.ndarray) -> str:
        array = np.asarray(self.values[id(part)].array)
        numbers = array[tuple(min(i, n - 1) for i, n in zip(at, array.shape, strict=False))]
        return (
            f"{part} = {numbers:.4g}" if numbers.ndim == 0 else f"{part} of {numbers.size} numbers"
        )


def _may_be_steep(e: x.Expression) -> bool:
    """True if a formula may have an infinite derivative where it is zero."""
    if isinstance(e, x.Application):
        return e.function in ("sqrt", "norm")
    if not (isinstance(e, x.Arithmetic) and e.symbol == "^"):
        return False
    return not (isinstance(e.parts[1], x.Literal) and e.parts[1].value >= 1)


def _search_group(
    program: Program, group: StepGroup, arrays: Arrays, changed: Arrays, slopes: bool
) -> None:
    """Compute a group part by part: inside a call, or up to the first time that is not finite."""
    scope = program.scope
    for step in group.steps if group.plan is None else group.plan.steps:
        axes = step.axes
        if group.plan is not None:
            time = group.plan.time_iterators[step.number]
            elements = axes[time].elements[: _first_bad_time(group.plan, changed) + 1]
            axes = axes | {time: IndexSet(axes[time].name, elements)}
        s = Context(scope, arrays | changed, axes, watch=_Monitor(slopes))
        if isinstance(step.statement, d.Call):
            _search_call(program, step, s)
        else:
            evaluate(step.statement.value, s)
    for name, array in changed.items():
        if not np.all(np.isfinite(array)):
            element = scope.arrays[name].element(int(np.argmax(~np.isfinite(np.ravel(array)))))
            raise _FoundError(f"{element} is not finite ({group.steps[0].at})")


def _first_bad_time(plan: RecurrencePlan, changed: Arrays) -> int:
    """Find the first time at which a recurrence is not finite; the last if all are."""
    bad = np.zeros(plan.length, bool)
    bad[-1] = True
    for name, w in plan.time_axes.items():
        rows = np.moveaxis(np.asarray(changed[name]), w.dim, 0)[w.start : w.start + plan.length]
        bad |= ~np.all(np.isfinite(rows.reshape(plan.length, -1)), axis=1)
    return int(np.argmax(bad))


def _search_call(program: Program, step: MappingStep, s: Context) -> None:
    """Search a called mapping, point by point."""
    callee = callee_of(s.scope, step.statement)
    if not isinstance(callee, Scope):
        return
    inner = Program(program.order.inner[step.statement.mapping], {})
    given = call_inputs(step.statement, callee, s)
    names = sorted({w.value.name for w in step.statement.outputs if isinstance(w.value, x.Name)})
    for at in np.ndindex(*[len(one) for one in s.axes.values()]):
        point = {
            n: a[tuple(min(i, m - 1) for i, m in zip(at, a.shape, strict=False))]
            for n, a in given.items()
        }
        iterators = [
            f"{n} = {one.elements[i]}" for (n, one), i in zip(s.axes.items(), at, strict=True)
        ]
        where = f" for {', '.join(iterators)}" if iterators else ""
        inside = f"in {step.statement.mapping}{where}: "
        if found := cause_of(inner, point, names, inside, s.watch.slopes):
            raise _FoundError(found)
