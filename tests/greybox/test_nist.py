"""NIST's certified nonlinear regressions: values, standard deviations, sums of squares.

All 27 data sets of the Statistical Reference Datasets, from the second certified start; the tables
are in nist_strd.json with their source.
"""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.greybox.fit import Status
from beamfit.greybox.problem import Free, Problem, Record
from beamfit.greybox.solve import solve

TABLES = json.loads((Path(__file__).parent / "nist_strd.json").read_text())


def gauss(b, x):
    peaks = b[2] * jnp.exp(-((x - b[3]) ** 2) / b[4] ** 2)
    peaks += b[5] * jnp.exp(-((x - b[6]) ** 2) / b[7] ** 2)
    return b[0] * jnp.exp(-b[1] * x) + peaks


def lanczos(b, x):
    return b[0] * jnp.exp(-b[1] * x) + b[2] * jnp.exp(-b[3] * x) + b[4] * jnp.exp(-b[5] * x)


def cubic(b, x):
    return (b[0] + x * (b[1] + x * (b[2] + x * b[3]))) / (1 + x * (b[4] + x * (b[5] + x * b[6])))


def chwirut(b, x):
    return jnp.exp(-b[0] * x) / (b[1] + b[2] * x)


def enso(b, x):
    turn = 2 * jnp.pi * x
    found = b[0] + b[1] * jnp.cos(turn / 12) + b[2] * jnp.sin(turn / 12)
    found += b[4] * jnp.cos(turn / b[3]) + b[5] * jnp.sin(turn / b[3])
    return found + b[7] * jnp.cos(turn / b[6]) + b[8] * jnp.sin(turn / b[6])


# The models as NIST prints them; Nelson's response is the logarithm of y.
MODELS = {
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": lambda b, x: b[0] * (1 - jnp.exp(-b[1] * x)),
    "Chwirut1": chwirut,
    "Chwirut2": chwirut,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "ENSO": enso,
    "Eckerle4": lambda b, x: b[0] / b[1] * jnp.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": gauss,
    "Gauss2": gauss,
    "Gauss3": gauss,
    "Hahn1": cubic,
    "Kirby2": lambda b, x: (b[0] + x * (b[1] + x * b[2])) / (1 + x * (b[3] + x * b[4])),
    "Lanczos1": lanczos,
    "Lanczos2": lanczos,
    "Lanczos3": lanczos,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * jnp.exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * jnp.exp(-x * b[3]) + b[2] * jnp.exp(-x * b[4]),
    "Misra1a": lambda b, x: b[0] * (1 - jnp.exp(-b[1] * x)),
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2.0),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Nelson": lambda b, x: b[0] - b[1] * x[0] * jnp.exp(-b[2] * x[1]),
    "Rat42": lambda b, x: b[0] / (1 + jnp.exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + jnp.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - jnp.arctan(b[2] / (x - b[3])) / jnp.pi,
    "Thurber": cubic,
}


def certified_problem(name):
    table, model = TABLES[name], MODELS[name]
    x = np.array(table["x"])
    y = np.log(table["y"]) if name == "Nelson" else np.array(table["y"])
    record = Record(name, model, x if len(x) > 1 else x[0], y)
    return Problem(np.array(table["start2"]), [Free("")], [record])


def test_all_27_problems_are_here():
    assert len(MODELS) == 27
    assert set(TABLES) - {"source", "fields"} == set(MODELS)


@pytest.mark.parametrize("name", MODELS)
def test_certified_values_are_reached_to_six_digits(name):
    table, p = TABLES[name], certified_problem(name)
    # The tables were copied right: the certified values give the certified sum of squares.
    r = np.asarray(p.residual(np.array(table["certified"])))
    assert r @ r == pytest.approx(table["rss"], rel=2e-8 if name != "Lanczos1" else 1)
    fit = solve(p)
    np.testing.assert_allclose(fit.theta, table["certified"], rtol=5e-7)
    assert fit.status == Status.converged
    assert fit.kkt.worst < 1e-6
    assert fit.dof == len(table["y"]) - len(table["certified"])
    # Lanczos1 is exact data: its residuals, 1e-13, are rounding.
    if name != "Lanczos1":
        assert fit.chi2 == pytest.approx(table["rss"], rel=1e-8)
        errors = [v.error for v in fit.variables]
        np.testing.assert_allclose(errors, table["sd"], rtol=1e-5)
