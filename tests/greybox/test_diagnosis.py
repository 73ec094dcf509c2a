"""A problem's ailments are found before it is solved, and named."""

import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.greybox.diagnosis import diagnose
from beamfit.greybox.problem import Constraint, Free, Objective, Prior, Problem, Record
from beamfit.greybox.solve import solve

X = np.arange(1.0, 5.0)
MODEL = {"a": 1.0, "b": 2.0, "c": 3.0}
FREE = [Free("a"), Free("b"), Free("c")]


def stated(predict, model=None, free=FREE, rows=4, **more):
    record = Record("scan", predict, X[:rows], np.ones(rows), 0.1)
    return Problem(model or MODEL, free, [record], **more)


def parabola(m, x):
    return m["a"] + m["b"] * x + m["c"] * x**2


def kinds(p):
    return {found.kind: found.names for found in diagnose(p)}


def test_a_sound_problem_has_none():
    assert diagnose(stated(parabola)) == ()


def test_too_few_rows_leave_all_they_touch_undetermined():
    assert kinds(stated(parabola, rows=2)) == {"undetermined": ("a", "b", "c")}
    assert diagnose(stated(parabola, rows=2, priors=[Prior("c", 3.0, 1.0)])) == ()


def test_only_the_part_that_lacks_rows_is_named():
    """`a` has rows of its own; `b` and `c` share one."""

    def split(m, x):
        return jnp.where(x < 4, m["a"] * x, m["b"] * m["c"])

    assert kinds(stated(split)) == {"undetermined": ("b", "c")}


def test_numbers_seen_only_together_are_found_though_rows_are_many():
    assert kinds(stated(lambda m, x: m["a"] * m["b"] * x + m["c"])) == {"undetermined": ("a", "b")}


def test_a_number_that_is_seen_at_some_points_is_determined():
    """Whichever of the points is looked at last, `c` counts above and below 0.8 in one of these."""

    def above(m, x):
        return m["a"] * x + m["b"] + m["c"] * x**2 * jnp.maximum(m["a"] - 0.8, 0.0)

    def below(m, x):
        return m["a"] * x + m["b"] + m["c"] * x**2 * jnp.maximum(0.8 - m["a"], 0.0)

    assert diagnose(stated(above)) == diagnose(stated(below)) == ()


def test_an_equation_determines_what_data_do_not():
    rule = Constraint("tie", lambda m, _: m["a"] - m["b"], None, 0.0, 0.0)
    assert diagnose(stated(lambda m, x: m["a"] * m["b"] * x + m["c"], constraints=[rule])) == ()


def test_unused_numbers_and_constant_constraints_are_named():
    rule = Constraint("idle", lambda m, _: jnp.asarray(1.0), None, 0.0)
    found = kinds(stated(lambda m, x: m["a"] + m["b"] * x, constraints=[rule]))
    assert found == {"unused": ("c",), "constant": ("idle",)}


def test_equations_that_follow_from_others_are_named():
    rules = [
        Constraint("one", lambda m, _: m["a"] + m["b"], None, 3.0, 3.0),
        Constraint("two", lambda m, _: 2 * m["a"] + 2 * m["b"], None, 6.0, 6.0),
        Constraint("three", lambda m, _: m["c"] ** 2, None, 9.0, 9.0),
    ]
    cost = Objective("f", lambda m, _: m["a"] ** 2 + m["b"] ** 2 + m["c"])
    assert kinds(Problem(MODEL, FREE, constraints=rules, objectives=[cost])) == {
        "dependent_equations": ("one", "two")
    }


def test_a_row_in_another_unit_is_told():
    rules = [
        Constraint(name, lambda m, _, k=k: k * m["a"] * m["b"] * m["c"], None, -9.0)
        for name, k in (("one", 1.0), ("two", 2.0), ("three", 1e-12))
    ]
    found = diagnose(stated(parabola, constraints=rules))
    assert [ailment.names for ailment in found] == [("three",)]
    assert "badly_scaled" in found[0]


def test_bounds_that_contradict_are_named_with_their_values():
    found = diagnose(stated(parabola, free=[Free("a"), Free("b", 2.0, 1.0), Free("c")]))
    assert found[0].kind == "contradictory_bounds"
    assert "the lower bound of b, 2, lies above its upper bound, 1" in found[0].message


@pytest.mark.parametrize(
    ("part", "said"),
    [
        (
            {"objectives": [Objective("height", lambda m, _: jnp.log(m["a"] - 5))]},
            "objective 'height' is nan",
        ),
        (
            {"constraints": [Constraint("root", lambda m, _: jnp.sqrt(m["a"] - 1), None, 0.0)]},
            "the derivative of constraint 'root' by a is inf",
        ),
    ],
)
def test_what_is_not_finite_at_the_start_is_traced(part, said):
    p = stated(parabola, **part)
    assert f"not finite at the start: {said};" in diagnose(p)[0].message


def test_solve_says_which_row_is_not_finite():
    fit = solve(stated(lambda m, x: jnp.sqrt(m["a"] - x / 2.5) + m["b"] + m["c"]))
    assert fit.status == "not_finite"
    assert "record 'scan' is nan in 2 of 4 values, the first [2]" in fit.message
