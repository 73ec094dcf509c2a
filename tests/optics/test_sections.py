"""Lines multiplied out before anything is traced: the same matrices, however long the line."""

from functools import reduce
from itertools import accumulate

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.extend.core import jaxprs_in_params

import beamfit
from beamfit.optics import beamline
from beamfit.optics.beamline import Beamline, transfer_rows
from beamfit.optics.calibration import CurrentPolynomial, IntegratedGradient, SlopeIntercept
from beamfit.optics.elements import Drift, Marker, Quadrupole, Screen, SectorDipole, ThinLens
from beamfit.optics.sections import ElementSeries, LineSection, in_series

ENERGIES = np.array([95.0, 100.0, 104.0])


def one_by_one(line, settings, energy):
    """Matrices to the exit of every element, and a bound of what rounding may do to each."""
    parts = [e.matrix(settings.get(e.name), energy).planes for e in line.elements]
    products = accumulate(parts, lambda total, part: np.asarray(part) @ total)
    sizes = accumulate(np.abs(parts), lambda total, part: part @ total)
    return [(np.asarray(p), 1e-14 * s.max()) for p, s in zip(products, sizes, strict=True)]


def agree(found, expected):
    product, rounding = expected
    np.testing.assert_allclose(found, product, rtol=1e-14, atol=rounding)


strengths = st.floats(-5.0, 5.0)
lengths = st.floats(0.01, 1.5)
kinds = st.one_of(
    st.builds(lambda v: Drift("D", v), lengths),
    st.builds(lambda v, k: Quadrupole("Q", v, k), lengths, strengths),
    st.builds(lambda v, k: Quadrupole("QG", v, k, IntegratedGradient()), lengths, strengths),
    st.builds(lambda k: Quadrupole("QI", 0.08, k, SlopeIntercept(160.0, 40.0)), strengths),
    st.builds(
        lambda k, s: Quadrupole("QP", 0.1, k, CurrentPolynomial((0.1, 2.0, -0.01), s)),
        strengths,
        st.booleans(),
    ),
    st.builds(lambda k: ThinLens("L", k), strengths),
    st.builds(lambda k: ThinLens("LG", k, IntegratedGradient()), strengths),
    st.builds(
        lambda angle, edge, plane, k: SectorDipole("B", 2.0, angle, edge, -edge, plane, 0.01, k),
        st.floats(0.05, 0.5),
        st.floats(-0.3, 0.3),
        st.sampled_from("xy"),
        strengths,
    ),
    st.just(Marker("M")),
    st.just(Screen("S", 1e-5)),
)


@st.composite
def lines(draw):
    """A line with varied magnets at both ends, and screens in the middle and at the end."""
    half = st.lists(kinds, max_size=8)
    magnet = Quadrupole("A", 0.1, 2.0, IntegratedGradient())
    middle = (*draw(half), Screen("OTR1"), *draw(half))
    return Beamline((magnet, *middle, ThinLens("Z", 0.3), Screen("OTR2")), energy=100.0)


@settings(max_examples=10)  # each compiles a program of its own
@given(lines(), st.lists(strengths, min_size=3, max_size=3), st.booleans())
def test_rows_are_the_products_one_by_one(line, currents, own_energies):
    set_to = {"A": np.array(currents), "Z": 0.5 + np.array(currents)}
    energy = ENERGIES if own_energies else np.full(3, 101.0)
    places = ("OTR1", "OTR2")
    found = np.asarray(transfer_rows(line, set_to, energy, places).planes)
    for i in range(3):
        expected = one_by_one(line, {n: v[i] for n, v in set_to.items()}, energy[i])
        for p, place in enumerate(places):
            agree(found[i, :, p], expected[line._index(place)])


@given(lines(), strengths)
def test_matrices_without_jax_are_the_products_one_by_one(line, current):
    found = line.matrices(("OTR1", "OTR2"), {"Z": current}, 97.0)
    expected = one_by_one(line, {"Z": current}, 97.0)
    for place, matrix in found.items():
        assert isinstance(matrix.planes, np.ndarray)
        agree(matrix.planes, expected[line._index(place)])


@pytest.mark.parametrize("energy", [None, 40.0])
def test_every_lattice_condensed_is_the_lattice(root, energy):
    rings = {"spear3_2003.toml"}  # an operating point for lifetimes, without elements
    for path in sorted((root / "lattices").glob("*.toml")):
        if path.name in rings:
            continue
        line = beamfit.load_lattice(path)
        at = line.energy if energy is None else energy
        expected = one_by_one(line, {}, at)
        for short in (
            line.condensed((*line.magnets, *line.screens)),
            line.condensed(line.screens),
            line.condensed(line.screens, at),
            line.stored_by_kind(line.screens),
        ):
            assert short.length == pytest.approx(line.length, rel=1e-14)
            for screen, matrix in short.matrices(line.screens, None, at).items():
                agree(np.asarray(matrix.planes), expected[line._index(screen)])


def test_rows_of_a_long_line_taken_by_turns_are_the_same(monkeypatch):
    line = cells(20, IntegratedGradient())
    set_to = {"F0": np.linspace(0.5, 1.5, 7)}
    energy = np.linspace(95.0, 105.0, 7)
    at_once = transfer_rows(line, set_to, energy, ("END",)).planes
    monkeypatch.setattr(beamline, "MAX_MATRICES", 100)
    beamline._rows.clear_cache()
    by_turns = transfer_rows(line, set_to, energy, ("END",)).planes
    beamline._rows.clear_cache()
    np.testing.assert_allclose(by_turns, at_once, rtol=1e-13)


def cells(number, *calibration):
    """FODO cells, their magnets named F0, D0, F1, ..., then a screen."""
    elements = []
    for i in range(number):
        for name, sign in (("F", 1.0), ("D", -1.0)):
            elements.append(Quadrupole(f"{name}{i}", 0.1, sign, *calibration))
            elements.append(Drift(f"{name}{i}.drift", 0.4 + 0.001 * i))
    return Beamline((*elements, Screen("END")), energy=100.0)


def equations(jaxpr):
    """Number of equations of a program, those of its loops and inner programs counted once."""
    inner = [v for e in jaxpr.eqns for v in jaxprs_in_params(e.params)]
    return len(jaxpr.eqns) + sum(equations(j) for j in inner)


@pytest.mark.parametrize("own_energies", [False, True])
def test_what_is_compiled_does_not_grow_with_the_line(own_energies):
    """The reason why 5000 elements cost what 50 do: the program is the same."""
    sizes = []
    for number in (10, 200):
        line = cells(number, IntegratedGradient())
        set_to = {"D3": np.ones(3)}
        energy = ENERGIES if own_energies else np.full(3, 100.0)
        short = beamline.reduced_line(line, set_to, energy, ("END",))
        program = jax.make_jaxpr(beamline._rows, static_argnums=3)(short, set_to, energy, ("END",))
        sizes.append(equations(program.jaxpr))
    assert sizes[0] == sizes[1]


def test_what_is_compiled_grows_gently_with_the_varied_magnets():
    """Reading a setting out costs an equation or two; no quadrupole and no product is repeated."""
    sizes = []
    for number in (5, 80):
        line = cells(number)
        set_to = {m: jnp.ones(()) for m in line.magnets}
        program = jax.make_jaxpr(lambda s, line=line: line.matrix(s).planes)(set_to)
        sizes.append(equations(program.jaxpr))
    assert sizes[1] - sizes[0] <= 2 * (160 - 10) + 10


def test_derivatives_are_those_of_the_products_one_by_one():
    line = cells(6, IntegratedGradient())

    def ours(k, energy, scale):
        magnet = Quadrupole("F2", 0.1, 0.0, IntegratedGradient(scale=scale))
        return line.with_element(magnet).matrix({"F2": k, "D5": 2.0 * k}, energy).planes

    def theirs(k, energy, scale):
        magnet = Quadrupole("F2", 0.1, 0.0, IntegratedGradient(scale=scale))
        own = {"F2": k, "D5": 2.0 * k}
        parts = [
            jnp.asarray(e.matrix(own.get(e.name), energy).planes)
            for e in line.with_element(magnet).elements
        ]
        return reduce(lambda total, part: part @ total, parts)

    at = (1.3, 101.0, 0.9)
    expected_slopes = jax.jit(jax.jacfwd(theirs, (0, 1, 2)))(*at)
    for mode in (jax.jacfwd, jax.jacrev):
        for slope, expected in zip(
            jax.jit(mode(ours, (0, 1, 2)))(*at), expected_slopes, strict=True
        ):
            np.testing.assert_allclose(slope, expected, rtol=1e-12, atol=1e-13)


def test_what_feels_the_energy_stays_and_the_rest_is_multiplied_out():
    plain, gradient = Quadrupole("A", 0.1, 2.0), Quadrupole("B", 0.1, 2.0, IntegratedGradient())
    parts = (Drift("1", 1.0), plain, gradient, Drift("2", 1.0), gradient, Drift("3", 1.0), plain)
    series = in_series(parts).multiplied()
    assert isinstance(series, ElementSeries)
    assert [type(k) for k in series.kinds] == [LineSection, Quadrupole]
    assert series.order.tolist() == [0, 3, 1, 4, 2]
    assert isinstance(in_series(parts[:2]).multiplied(), LineSection)


def test_elements_that_share_a_kind_are_stored_in_one():
    kinds = in_series(cells(30).elements).kinds
    assert [type(k) for k in kinds] == [Quadrupole, Drift]
    assert kinds[1].length.shape == (60,)
