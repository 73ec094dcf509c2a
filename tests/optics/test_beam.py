"""The beam matrix: invariants and limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamfit.errors import InputError
from beamfit.optics.beam import BeamMatrix
from beamfit.optics.elements import Drift, Quadrupole

twiss = st.tuples(st.floats(1e-10, 1e-5), st.floats(0.05, 200.0), st.floats(-20.0, 20.0))
GTF = (2.62035e-8, 1.55237e-8, 1.40828e-8)  # report table 2, first row, in SI


@given(twiss)
def test_twiss_go_in_and_come_out(given_twiss):
    emittance, beta, alpha = given_twiss
    beam = BeamMatrix.from_twiss(emittance, beta, alpha)
    assert float(beam.emittance) == pytest.approx(emittance, rel=1e-13)
    assert float(beam.twiss.beta) == pytest.approx(beta, rel=1e-13)
    assert float(beam.twiss.alpha) == pytest.approx(alpha, rel=1e-13, abs=1e-15)
    np.testing.assert_allclose(
        beam.sigma,
        emittance * np.array([[beta, -alpha], [-alpha, (1 + alpha**2) / beta]]),
        rtol=1e-12,
        atol=1e-290,
    )


def test_sigma_goes_in_and_comes_out():
    s11, s12, s22 = GTF
    beam = BeamMatrix.from_sigma(s11, s12, s22)
    np.testing.assert_allclose(beam.sigma, [[s11, s12], [s12, s22]], rtol=1e-13)
    assert float(beam.emittance) == pytest.approx(np.sqrt(s11 * s22 - s12**2), rel=1e-12)


@given(twiss, st.floats(-20, 20))
def test_transport_is_congruence_and_keeps_the_emittance(given_twiss, k1):
    beam = BeamMatrix.from_twiss(*given_twiss)
    r = (Drift("D", 2.0).matrix() @ Quadrupole("Q", 0.2, k1).matrix()).x[:2, :2]
    after = beam.transport(r)
    np.testing.assert_allclose(
        after.sigma, r @ beam.sigma @ r.T, rtol=1e-8, atol=1e-11 * float(beam.sigma.max())
    )
    assert float(after.emittance) == pytest.approx(given_twiss[0], rel=1e-9)


def test_drift_moves_the_waist_by_its_length():
    """β(s) = β* + s²/β* and α = -s/β* from a waist β* (any text on optics)."""
    after = BeamMatrix.from_twiss(1e-9, 0.5, 0.0).transport(Drift("D", 2.0).matrix().x)
    assert float(after.twiss.beta) == pytest.approx(0.5 + 4.0 / 0.5, rel=1e-13)
    assert float(after.twiss.alpha) == pytest.approx(-2.0 / 0.5, rel=1e-13)


@given(twiss, twiss)
def test_mismatch_is_the_trace_of_the_two_matrices(first, second):
    beam, design = BeamMatrix.from_twiss(*first), BeamMatrix.from_twiss(*second)
    trace = jnp.trace(beam.sigma @ jnp.linalg.inv(design.sigma))
    expected = trace * design.emittance / beam.emittance / 2
    assert float(beam.mismatch(design)) == pytest.approx(float(expected), rel=1e-5)
    assert float(beam.mismatch(design)) >= 1.0 - 1e-9


def test_any_cholesky_number_is_a_beam():
    """Half of all random starts of the report's appendices had no square root; none here has."""
    numbers = jax.random.normal(jax.random.key(0), (1000, 3))
    beams = jax.vmap(lambda f: BeamMatrix(l11=f[0], l21=f[1], l22=f[2]))(numbers)
    assert bool(jnp.all(jnp.linalg.eigvalsh(beams.sigma) >= -1e-15))
    assert bool(jnp.all(beams.emittance >= 0))


def test_three_numbers_without_names_are_refused():
    """They may be Cholesky factors, sigmas or emittance and Twiss parameters."""
    with pytest.raises(TypeError, match="positional"):
        BeamMatrix(1.0, 0.0, 1.0)


@pytest.mark.parametrize("bad", [(1.0, 2.0, 1.0), (-1.0, 0.0, 1.0)])
def test_an_indefinite_matrix_is_refused(bad):
    with pytest.raises(InputError, match="positive definite"):
        BeamMatrix.from_sigma(*bad)


def test_negative_emittance_is_refused():
    with pytest.raises(InputError, match="emittance = -1e-09; expected a positive number"):
        BeamMatrix.from_twiss(-1e-9, 1.0, 0.0)


def test_normalised_emittance_of_the_gtf_beam():
    """βγ at 30.5 MeV is 59.6787: sqrt((E/m)² - 1)."""
    beam = BeamMatrix.from_sigma(*GTF)
    ratio = float(beam.normalized_emittance(30.5) / beam.emittance)
    assert ratio == pytest.approx(np.sqrt((30.5 / 0.51099895069) ** 2 - 1), rel=1e-12)
