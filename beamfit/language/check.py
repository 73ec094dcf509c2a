"""Check a document before JAX is loaded."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from beamfit.errors import nearest
from beamfit.language import document as d
from beamfit.language.expression import error_at
from beamfit.language.order import checked


def check_document(
    document: d.Document,
    shapes: Mapping[str, tuple[int, int]] | None = None,
    given: Iterable[str] = (),
) -> None:
    """Check the names, indices and order of a document, its variables and their bounds.

    Parameters
    ----------
    document : Document
        From a file.
    shapes : mapping of str to (int, int), optional
        Rows and columns of its tables, where they have been read.
    given : iterable of str, optional
        Inputs whose values come from elsewhere.

    Raises
    ------
    InputError
        With the place in the document.
    """
    checked(document.mapping, shapes)
    if document.problem is not None:
        check_problem(document, given)


def check_problem(document: d.Document, given: Iterable[str] = ()) -> None:
    """Refuse names that the mapping has not, bounds that contradict, and inputs without a value."""
    p, m = document.problem, document.mapping
    faces = (p.variables, m.inputs, "input"), ((*p.goals, *p.limits), m.outputs, "output")
    for group, face, what in faces:
        known = [one.name for one in face]
        for one in group:
            if one.model not in known:
                found = f"no {what} '{one.model}' in the mapping"
                raise error_at(one.at, found, nearest(one.model, known))
    sizes = {one.name: one.dimensions for one in m.outputs}
    for one in p.goals:
        if sizes[one.model]:
            found = f"'{one.model}' of {len(sizes[one.model])} dimension(s) as an objective"
            raise error_at(one.at, found, "an output that is a number, such as a sum(... | ...)")
    _check_variables(p)
    names = [*(v.model for v in p.variables), *given]
    for one in m.inputs:
        if one.values is None and one.name not in names:
            expected = f"variable {one.name};, input {one.name} = VALUE;, or --set {one.name}=VALUE"
            raise error_at(one.at, f"input '{one.name}' without a value", expected)


def _check_variables(p: d.ProblemStatement) -> None:
    for one in (*p.variables, *p.limits):
        if not one.lower <= one.upper:
            found = f"bounds of '{one.label}' from {one.lower:g} up to {one.upper:g}"
            raise error_at(one.at, found, "a lower bound that is not above the upper one")
    names = [v.model for v in p.variables]
    for v in p.variables:
        if names.count(v.model) > 1:
            raise error_at(v.at, f"variable '{v.model}' twice", "each variable once")
        low, high = v.random or (0.0, 0.0)
        if not (low <= high and math.isfinite(high - low)):
            found = f"a random start of '{v.label}' in [{low:g}, {high:g}]"
            raise error_at(v.at, found, "a finite range, the lower end first")
