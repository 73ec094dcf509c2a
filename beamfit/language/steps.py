"""Steps of a mapping: what they write, what they read, and what a call calls."""

from __future__ import annotations

from beamfit.errors import nearest
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.expression import error_at
from beamfit.language.scope import Axes, MappingStep, Net, Read, Scope, located, widened


def callee_of(scope: Scope, call: d.Call) -> Scope | Net:
    """Find what a call calls, and check the names on both sides."""
    callee = scope.callees.get(call.mapping)
    if callee is None:
        known = nearest(call.mapping, list(scope.callees))
        raise error_at(call.at, f"unknown mapping '{call.mapping}'", known)
    for wire in call.inputs:
        if wire.target.name not in callee.inputs:
            known = nearest(wire.target.name, list(callee.inputs))
            found = f"unknown input '{wire.target.name}' of {call.mapping}"
            raise error_at(wire.target.at, found, known)
    given = [w.target.name for w in call.inputs if not w.target.indices]
    for name, wanted in callee.inputs.items():
        if wanted.values is None and name not in [w.target.name for w in call.inputs]:
            found = f"input '{name}' of {call.mapping} is not given"
            raise error_at(call.at, found, f"{name} = ... before '::'")
        if given.count(name) > 1:
            raise error_at(call.at, f"input '{name}' of {call.mapping} given twice", "once")
    if not call.outputs:
        raise error_at(call.at, f"a call of {call.mapping} without outputs", "outputs behind '::'")
    for wire in call.outputs:
        gains_of(wire, callee, call.mapping)
    return callee


def gains_of(
    wire: d.Assignment, callee: Scope | Net, label: str
) -> tuple[x.Name, tuple[x.Name, ...]]:
    """The output behind a wire, and the inputs by which it is differentiated: `gain(y, x)`."""
    names = (wire.value,)
    if isinstance(wire.value, x.Application) and wire.value.function == "gain":
        names = wire.value.arguments
    wrong = [e for e in names if not isinstance(e, x.Name)]
    if wrong or not names:
        at = (wrong or [wire.value])[0].at
        raise error_at(at, f"'{wire.value}'", f"an output of {label}, or gain(output, input)")
    faces = [callee.outputs, *[callee.inputs] * (len(names) - 1)]
    for e, face, what in zip(names, faces, ["output", *["input"] * (len(names) - 1)], strict=True):
        if e.name not in face:
            known = nearest(e.name, list(face))
            raise error_at(e.at, f"unknown {what} '{e.name}' of {label}", known)
    return names[0], names[1:]


def targets(scope: Scope, step: MappingStep) -> list[tuple[x.Name, Axes]]:
    """Names that a step writes, with the iterators in force there."""
    if isinstance(step.what, d.Assignment):
        return [(step.what.target, step.axes)]
    return [(w.target, widened(scope, step.axes, w.each)) for w in step.what.outputs]


def sources(scope: Scope, step: MappingStep) -> list[tuple[x.Expression, Axes]]:
    """Expressions that a step reads, with the iterators in force there."""
    if isinstance(step.what, d.Assignment):
        return [(step.what.value, step.axes)]
    return [(w.value, widened(scope, step.axes, w.each)) for w in step.what.inputs]


def written(scope: Scope, node: x.Name, axes: Axes) -> Read:
    """The elements a target writes; it must be an output or a local variable."""
    found = scope.arrays.get(node.name)
    if found is None or found.role not in ("output", "real"):
        free = [a.name for a in scope.arrays.values() if a.role in ("output", "real")]
        known = nearest(node.name, free)
        if found is None:
            raise error_at(node.at, f"unknown name '{node.name}'", f"{known}, or real {node.name};")
        raise error_at(node.at, f"{found.role} '{node.name}' set by a statement", known)
    return Read(found, node, axes, located(scope, node, found, axes))
