"""Scenarios: what each finds on simulated scans with a known truth, and what it says it cannot."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import beamfit
from beamfit.emittance.assumptions import Anchor, Assumptions
from beamfit.emittance.calibration import with_numbers
from beamfit.emittance.model import UNIT, model_quantities
from beamfit.emittance.statement import answer_places, prepare
from beamfit.emittance.transport_network import SCENARIO as TRANSPORT_NETWORK
from beamfit.errors import InputError
from beamfit.greybox.bounds import cells, over_cells
from beamfit.greybox.signed_network import certificate_of
from beamfit.greybox.solve import solve
from beamfit.optics.calibration import IntegratedGradient, SlopeIntercept
from beamfit.optics.elements import Quadrupole, Screen
from beamfit.particles import beta_gamma
from tests.emittance.conftest import TABLE_2

TRUE_EMITTANCE = np.sqrt(TABLE_2[0] * TABLE_2[2] - TABLE_2[1] ** 2)
PRIOR = {"Q2.slope": (167.23, 3.3446)}
ANCHOR = Anchor(deviation=0.02)


@pytest.fixture(scope="module")
def scan(root):
    return beamfit.read_quad_scan(root / "measurements/gtf_simulated.csv")


@pytest.fixture(scope="module")
def two(root):
    """A scan on two screens, whose true slope and intercept are 160 and 50, not the lattice's."""
    return (
        beamfit.read_quad_scan(root / "measurements/gtf_two_screens_simulated.csv"),
        beamfit.load_lattice(root / "lattices/gtf_two_screens.toml"),
    )


@pytest.fixture(scope="module")
def free(scan, gtf):
    return beamfit.fit_emittance(scan, gtf, scenario="calibration")


@pytest.fixture(scope="module")
def with_prior(scan, gtf):
    return beamfit.fit_emittance(scan, gtf, scenario="calibration", priors=PRIOR)


@pytest.fixture(scope="module")
def network(scan, gtf):
    return beamfit.fit_emittance(scan, gtf, scenario="transport-network")


@pytest.fixture(scope="module")
def anchored(scan, gtf):
    return beamfit.fit_emittance(scan, gtf, scenario="transport-network", anchor=ANCHOR)


def named(fit, name):
    return next(p for p in fit.parameters if p.name == name)


def test_one_scan_does_not_identify_the_calibration(free):
    assert free.x.status.value == "unidentified"
    assert free.x.emittance.error is None
    slope = named(free, "Q2.slope")
    assert slope.state in ("lower", "upper")
    assert slope.value.error is None
    assert slope.multiplier != 0.0
    assert "Q2.slope ends at its" in free.x.message
    assert any("emittance as 1/slope" in words for words in free.null_directions)


def test_the_slope_and_the_emittance_are_one_direction(scan, gtf, free):
    """Along the named direction, slope up and emittance down, χ² does not move."""
    known = beamfit.fit_emittance(scan, gtf)
    for slope in (150.0, 185.0):
        moved = beamfit.fit_emittance(scan, with_numbers(gtf, {"Q2.slope": slope}))
        assert moved.x.chi2 == pytest.approx(known.x.chi2, abs=0.1)
        assert moved.x.emittance.value == pytest.approx(
            known.x.emittance.value * 167.23 / slope, rel=0.01
        )


def test_a_prior_on_the_slope_determines_the_emittance(scan, gtf, with_prior):
    known = beamfit.fit_emittance(scan, gtf)
    assert with_prior.x.status.value == "converged"
    relative = with_prior.x.emittance.relative
    # 0.98 is d ln(emittance)/d ln(slope), from the systematics budget; the rest adds to that.
    budget = {c.cause: c.emittance for c in beamfit.systematics(known, "x")}
    slope = 2.0 * abs(budget["Q2 slope +1 %"])
    assert np.hypot(slope, known.x.emittance.relative) == pytest.approx(relative, rel=0.2)
    assert 0.02 < relative < 0.03
    assert abs(with_prior.x.emittance.value - TRUE_EMITTANCE) < 3 * with_prior.x.emittance.error
    # A shift of k1 is undone by a lens in the beam: alpha is open, the emittance is not.
    assert with_prior.x.alpha.error is None
    assert named(with_prior, "Q2.intercept").value.error is None


def test_a_second_screen_identifies_the_calibration_and_recovers_the_truth(two):
    fit = beamfit.fit_emittance(*two, scenario="calibration")
    assert fit.x.status.value == "converged"
    slope = named(fit, "Q2.slope").value
    assert abs(slope.value - 160.0) < 3 * slope.error < 0.06 * 160.0
    assert abs(fit.x.emittance.value - TRUE_EMITTANCE) < 3 * fit.x.emittance.error
    # With the lattice's own calibration the same scan gives another answer and a bad fit.
    wrong = beamfit.fit_emittance(*two)
    assert wrong.x.chi2 > fit.x.chi2 + 4


def scan_at(line, currents, energies, sigma, relative=0.01, seed=5):
    """A simulated scan of Q2 at each of several energies, one after the other.

    The beam is sigma at their mean energy, with the same normalised emittance at all of them.
    """
    current, energy = np.tile(currents, len(energies)), np.repeat(energies, len(currents))
    true = []
    for i, e in zip(current, energy, strict=True):
        a, b = np.asarray(line.matrix({"Q2": i}, e).x)[0, :2]
        damped = sigma * beta_gamma(np.mean(energies), line.mass) / beta_gamma(e, line.mass)
        true.append(np.sqrt(damped @ [a * a, 2 * a * b, b * b]))
    true = np.array(true)
    sizes = true * (1 + relative * np.random.default_rng(seed).normal(size=len(true)))
    return beamfit.QuadScan(
        {"Q2": current}, {"Q2": "A"}, {"x": sizes}, {"x": relative * true}, energy=energy
    )


def test_a_second_energy_identifies_where_a_known_lens_stands_by():
    line = beamfit.Beamline(
        (
            Quadrupole("QK", 0.1, 2.0, IntegratedGradient()),
            beamfit.Drift("D0", 0.8),
            Quadrupole("Q2", 0.08, 0.0, SlopeIntercept(165.0, 0.0)),
            beamfit.Drift("D1", 2.0),
            Screen("S"),
        ),
        energy=30.0,
    )
    sigma = np.array([4e-8, 0.0, 1.2e-8])
    truth = with_numbers(line, {"Q2.slope": 160.0})
    currents = np.linspace(-2.0, 4.0, 13)
    one = scan_at(truth, currents, [30.0, 30.0], sigma)
    assert beamfit.fit_emittance(one, line, scenario="calibration").x.emittance.error is None
    two = scan_at(truth, currents, [30.0, 20.0], sigma)
    fit = beamfit.fit_emittance(two, line, scenario="calibration")
    slope = named(fit, "Q2.slope").value
    assert abs(slope.value - 160.0) < 3 * slope.error < 5.0
    emittance = np.sqrt(sigma[0] * sigma[2] - sigma[1] ** 2)
    assert fit.x.emittance.error is not None
    assert abs(fit.x.emittance.value - emittance) < 3 * fit.x.emittance.error


def test_on_the_gtf_line_a_second_energy_does_not(gtf):
    """Its fixed quadrupole is weak: sizes at 30.5 and 38 MeV are one family of parabolas."""
    scan = scan_at(gtf, np.linspace(0.0, 3.9, 14), [30.5, 38.0], TABLE_2, relative=0.02)
    fit = beamfit.fit_emittance(scan, gtf, scenario="calibration")
    assert fit.x.status.value == "unidentified"
    assert fit.x.emittance.error is None


def test_both_planes_share_one_calibration(root):
    scan = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    line = beamfit.load_lattice(root / "lattices/lcls_otr2.toml")
    fit = beamfit.fit_emittance(
        scan, line, scenario="calibration", priors={"Q525.scale": (1, 0.01)}
    )
    assert [p.plane for p in fit.planes] == ["x", "y"]
    assert [p.name for p in fit.parameters] == ["Q525.scale"]
    known = beamfit.fit_emittance(scan, line)
    for plane in "xy":
        assert fit[plane].emittance.value == pytest.approx(known[plane].emittance.value, rel=0.05)


def test_a_transport_network_alone_names_its_null_space(network):
    assert network.x.status.value == "unidentified"
    assert network.x.emittance.error is None
    assert network.x.normalized_emittance.to_json()["error"] is None
    assert "[A B] -> [A B] G" in network.null_directions[0]


def test_the_null_space_is_what_it_says(network):
    """Any G in the network's last layer, with its inverse in the beam, leaves every size."""
    model = network.fit.model
    g = np.array([[1.3, 0.2], [-0.4, 0.9]])
    net, beam = model["map"], model["beam"]["x"]
    [record] = network.problem.records
    before = np.asarray(record.predict(model, record.data))
    scale = np.array([p.scale for p in net.output_ports])
    bias = np.array([p.bias for p in net.output_ports])
    # Outputs are bias + scale * node: G acts on physical A, B.
    last = np.asarray(net.weights["layer1->layer2"]) * scale @ g / scale
    offset = ((np.asarray(net.biases["layer2"]) * scale + bias) @ g - bias) / scale
    lower = UNIT * np.array([[beam["l11"], 0.0], [beam["l21"], beam["l22"]]])
    inverse = np.linalg.inv(g)
    moved = np.linalg.cholesky(inverse @ lower @ lower.T @ inverse.T) / UNIT
    changed = {
        "beam": {"x": {"l11": moved[0, 0], "l21": moved[1, 0], "l22": moved[1, 1]}},
        "map": type(net)(
            net.layers, net.connections, net.input_ports, net.output_ports,
            {**net.weights, "layer1->layer2": last}, {**net.biases, "layer2": offset},
        ),
    }  # fmt: skip
    after = np.asarray(record.predict(changed, record.data))
    assert after == pytest.approx(before, rel=1e-9)


def test_t_at_one_current_leaves_the_emittance_open():
    """[A0 B0] G = [A0 B0] has a family of G of any determinant, and C, D can follow: docs."""
    a0, b0, c0, d0 = 0.7, 2.1, -0.7, (1 - 0.7 * 2.1) / 0.7
    row = np.array([a0, b0])
    for determinant in (0.5, 2.0):
        across = np.array([-b0, a0]) / (row @ row)
        # G fixes the row [A0 B0] and scales what is across it.
        g = np.outer(row, row) / (row @ row) + determinant * np.outer(across, [-b0, a0])
        assert row @ g == pytest.approx(row)
        assert np.linalg.det(g) == pytest.approx(determinant)
        # At every other current [C' D'] with A'D' - B'C' = 1 exists, as (A', B') is not zero.
        other = np.array([-1.5, 1.6]) @ g
        c, d = np.array([-other[1], other[0]]) / (other @ other)
        assert other[0] * d - other[1] * c == pytest.approx(1.0)
    assert a0 * d0 - b0 * c0 == pytest.approx(1.0 - 2.1 + 2.1)


@pytest.mark.parametrize("determinant", [False, True])
def test_and_the_fit_says_so(scan, gtf, determinant):
    anchor = Anchor(at=({"Q2": 0.0},), determinant=determinant)
    fit = beamfit.fit_emittance(
        scan, gtf, scenario="transport-network", anchor=anchor, hidden=2, starts=1
    )
    assert fit.x.emittance.error is None
    assert fit.x.status.value == "unidentified"
    assert fit.null_directions


def test_an_anchored_network_is_right(scan, gtf, anchored):
    assert anchored.x.status.value == "converged"
    known = beamfit.fit_emittance(scan, gtf)
    assert known.x.emittance.relative < anchored.x.emittance.relative < 0.05
    assert abs(anchored.x.emittance.value - TRUE_EMITTANCE) < 3 * anchored.x.emittance.error
    assert anchored.fit.kkt.worst < 1e-6


@pytest.mark.parametrize("which", ["network", "anchored"])
def test_gains_fall_everywhere(which, request):
    """Certified over the whole range, and seen so by dense sampling (report eqs 38, 39)."""
    fit = request.getfixturevalue(which)
    net = fit.fit.model["map"]
    found = certificate_of(fit.problem, net)
    assert found.holds
    assert found.box == {"Q2": (0.0, 3.9)}
    assert [g.sign for g in found.gains] == [-1, -1]
    slopes = jax.jit(jax.vmap(jax.jacfwd(net.values)))(jnp.linspace(0.0, 3.9, 5001)[:, None])
    assert float(slopes.max()) <= 0.0
    bound = over_cells(net, *cells([0.0], [3.9], 32))
    assert float(bound.upper.max()) <= 1e-12
    for i, gain in enumerate(found.gains):
        inside = np.asarray(slopes)[:, i, 0]
        assert gain.lower <= inside.min()
        assert inside.max() <= gain.upper + 1e-12


def test_the_certificate_sees_a_network_that_rises(anchored):
    net = anchored.fit.model["map"]
    weights = {**net.weights, "layer1->layer2": -net.weights["layer1->layer2"]}
    risen = type(net)(
        net.layers, net.connections, net.input_ports, net.output_ports, weights, net.biases
    )
    assert not certificate_of(anchored.problem, risen).holds


def test_focusing_network_alone_and_with_a_second_screen(scan, gtf, two):
    alone = beamfit.fit_emittance(scan, gtf, scenario="focusing-network", starts=1)
    assert alone.x.emittance.error is None
    fit = beamfit.fit_emittance(*two, scenario="focusing-network", starts=2)
    assert fit.x.emittance.error is not None
    assert abs(fit.x.emittance.value - TRUE_EMITTANCE) < 3 * fit.x.emittance.error
    # k1 = (160 I + 50)/30.5 is the truth; a shift of k1 is a lens in the beam, so differences.
    low, middle, high = (named(fit, f"Q2.k1 at {i:g}").value for i in (0.0, 1.95, 3.9))
    assert high.value - low.value == pytest.approx(160.0 * 3.9 / 30.5, rel=0.06)
    assert middle.value - low.value == pytest.approx(160.0 * 1.95 / 30.5, rel=0.08)


def test_hysteresis_is_seen_and_measured(gtf):
    """k1 of a falling current lies 0.5 /m² above that of a rising one."""
    up, down = np.linspace(0.0, 3.9, 14), np.linspace(3.9, 0.0, 14)
    current = np.concatenate([up, down])
    shift = np.concatenate([np.zeros(14), np.full(14, 0.5)])
    true = []
    for i, s in zip(current, shift, strict=True):
        a, b = np.asarray(gtf.matrix({"Q2": i + s * 30.5 / 167.23}).x)[0, :2]
        true.append(np.sqrt(TABLE_2 @ [a * a, 2 * a * b, b * b]))
    true = np.array(true)
    sizes = true * (1 + 0.01 * np.random.default_rng(2).normal(size=28))
    scan = beamfit.QuadScan({"Q2": current}, {"Q2": "A"}, {"x": sizes}, {"x": 0.01 * true})
    told = {"scenario": "focusing-network", "anchor": ANCHOR, "starts": 1}
    fit = beamfit.fit_emittance(scan, gtf, hysteresis=True, **told)
    loop = named(fit, "Q2.k1 rising less falling at 1.95").value
    assert loop.error is not None
    assert abs(loop.value + 0.5) < 3 * loop.error
    assert abs(loop.value) > 3 * loop.error
    single = beamfit.fit_emittance(scan, gtf, **told)
    assert single.x.chi2 > fit.x.chi2 + 20


def test_hysteresis_of_a_scan_that_only_rises(scan, gtf):
    with pytest.raises(InputError, match="only rise or only fall"):
        beamfit.fit_emittance(scan, gtf, scenario="focusing-network", hysteresis=True)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scenario": "calibrations"}, "did you mean calibration"),
        ({"priors": PRIOR}, "scenario calibration"),
        ({"scenario": "calibration", "priors": {"Q2.slop": (1, 1)}}, "did you mean Q2.slope"),
        ({"scenario": "calibration", "priors": {"Q2.slope": (1, 0)}}, "positive deviation"),
        ({"scenario": "calibration", "bounds": {"Q2.slope": (2, 1)}}, "lower first"),
        ({"scenario": "transport-network", "anchor": "determinant"}, r"beamfit.Anchor\("),
        ({"scenario": "calibration", "priors": "Q2.slope=167+-3"}, r"a str, .*such as priors="),
        ({"scenario": "calibration", "priors": {"Q2.slope": 167.0}}, "a pair of numbers"),
        ({"noise": "shots.toml"}, r"beamfit.Noise\("),
        ({"scenario": "calibration", "anchor": ANCHOR}, "transport-network or focusing-network"),
        ({"scenario": "transport-network", "anchor": Anchor(at=({"Q1": 0.0},))}, "scanned magnet"),
        ({"scenario": "calibration", "hysteresis": True}, "focusing-network"),
    ],
)
def test_what_does_not_fit_is_named(scan, gtf, options, words):
    with pytest.raises(InputError, match=words):
        beamfit.fit_emittance(scan, gtf, **options)


def test_every_result_has_a_problem_to_sample(scan, gtf, with_prior, anchored):
    known = beamfit.fit_emittance(scan, gtf)
    problem = known.problem
    # By the errors found, at which the sizes of the closed form are stated.
    off = (known.x.points.size - known.x.points.model) * (
        known.x.points.size + known.x.points.model
    )
    pulls = off / (2.0 * known.x.points.weighed * known.x.points.error)
    assert 2 * float(problem.cost(problem.start)) == pytest.approx(float(pulls @ pulls), rel=1e-9)
    for fit in (with_prior, anchored):
        assert np.isfinite(float(fit.problem.log_probability(fit.fit.theta)))


def test_three_quads_two_screens_two_energies(three_quads):
    """Several magnets, screens and energies in one fit of a calibration."""
    random = np.random.default_rng(4)
    n = 24
    settings = {"QA": random.uniform(2, 7, n), "QB": random.uniform(-2.5, -0.8, n)}
    screens = tuple(np.where(np.arange(n) % 2, "YAG1", "YAG2"))
    energy = np.where(np.arange(n) % 3, 250.0, 230.0)
    truth = with_numbers(three_quads, {"QA.scale": 1.03})
    sigma = np.array([4e-8, -1e-8, 0.5e-8])
    true = []
    for i in range(n):
        own = {name: v[i] for name, v in settings.items()}
        a, b = np.asarray(truth.upto(screens[i]).matrix(own, energy[i]).x)[0, :2]
        damped = sigma * energy.mean() / energy[i]
        true.append(np.sqrt(damped @ [a * a, 2 * a * b, b * b] + (8e-6) ** 2))
    true = np.array(true)
    scan = beamfit.QuadScan(
        settings, {"QA": "kG", "QB": "A"}, {"x": true * (1 + 0.01 * random.normal(size=n))},
        {"x": 0.01 * true}, energy=energy, screen=screens,
    )  # fmt: skip
    priors = {"QB.coefficients.0": (0.02, 0.002), "QB.coefficients.1": (1.6, 0.016)}
    fit = beamfit.fit_emittance(scan, three_quads, scenario="calibration", priors=priors)
    scale = named(fit, "QA.scale").value
    assert scale.error is not None
    assert abs(scale.value - 1.03) < 3 * scale.error
    emittance = np.sqrt(sigma[0] * sigma[2] - sigma[1] ** 2)
    assert abs(fit.x.emittance.value - emittance) < 3 * fit.x.emittance.error
    network = beamfit.fit_emittance(
        scan, three_quads, scenario="transport-network", anchor=ANCHOR, starts=1
    )
    assert network.fit.model["map"].inputs == ("QA", "QB", "energy")
    assert len(network.fit.model["map"].output_ports) == 4


def test_training_from_many_starts_is_no_worse_than_from_one(scan, gtf):
    problem = TRANSPORT_NETWORK.state(prepare(scan, gtf), Assumptions(anchor=ANCHOR))
    assert solve(problem, 20).cost <= solve(problem, 1).cost + 1e-9


@pytest.mark.parametrize("plane", ["x", "y"])
def test_the_same_data_and_model_have_one_error(otr2_both, plane):
    """A calibration that is told is no unknown; each plane has the noise of its own sizes."""
    known, told = (fit[plane] for fit in otr2_both)
    for name in ("emittance", "normalized_emittance", "beta", "alpha", "mismatch"):
        a, b = getattr(known, name), getattr(told, name)
        assert b.value == pytest.approx(a.value, rel=1e-6)
        assert b.error == pytest.approx(a.error, rel=1e-6)
        assert b.error_raw == pytest.approx(a.error_raw, rel=1e-6)
    assert (told.status, told.dof) == (known.status, known.dof)
    assert told.chi2 == pytest.approx(known.chi2, rel=1e-6)
    assert told.error_scale == pytest.approx(known.error_scale, rel=1e-6)


@pytest.fixture(scope="module")
def otr2_both(root, otr2):
    scan = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    priors = {"Q525.scale": (1.0, 1e-9)}
    told = beamfit.fit_emittance(scan, otr2, scenario="calibration", priors=priors)
    return beamfit.fit_emittance(scan, otr2), told


@pytest.mark.parametrize("method", ["size_squared", "size"])
def test_the_closed_form_is_the_answer_of_the_problem(root, otr2, method):
    """Values of the fast path, and its errors by those found, against the core's own fit."""
    scan = beamfit.read_quad_scan(root / "measurements/lcls_otr2.csv")
    fast = beamfit.fit_emittance(scan, otr2, method=method)
    for plane in "xy":
        found = fast.fit.derive(model_quantities, answer_places(fast.seen, plane))
        one = fast[plane]
        quoted = [one.emittance, one.normalized_emittance, one.beta, one.alpha, *one.sigma]
        np.testing.assert_allclose(found.value[:7], [q.value for q in quoted], rtol=1e-8)
        assert fast.fit.group(f"size {plane}").dof == pytest.approx(one.dof, abs=1e-9)
        # Linear theory with the errors that the posterior found, by hand.
        p = one.points
        rows = np.stack([p.r11**2, 2 * p.r11 * p.r12, p.r12**2], -1)
        rows = rows / (2 * (p.weighed if method == "size_squared" else p.model) * p.error)[:, None]
        covariance = np.linalg.inv(rows.T @ rows)
        tolerance = 1e-7 if method == "size_squared" else 1e-5
        np.testing.assert_allclose(
            found.error_raw[4:7], np.sqrt(np.diag(covariance)), rtol=tolerance
        )


@pytest.mark.parametrize("name", ["map", "beam", "x", "magnets"])
def test_a_magnet_may_have_any_name(scan, gtf, with_prior, name):
    elements = tuple(replace(e, name=name) if e.name == "Q2" else e for e in gtf.elements)
    line = replace(gtf, elements=elements)
    renamed = replace(scan, settings={name: scan.settings["Q2"]}, units={name: "A"}, columns={})
    told = {f"{name}.slope": PRIOR["Q2.slope"]}
    fit = beamfit.fit_emittance(renamed, line, scenario="calibration", priors=told)
    assert fit.x.emittance.value == pytest.approx(with_prior.x.emittance.value, rel=1e-9)
    assert {p.name for p in fit.parameters} == {f"{name}.slope", f"{name}.intercept"}
    assert fit.line[name].calibration.slope == pytest.approx(
        named(fit, f"{name}.slope").value.value
    )


def test_every_start_of_a_training_is_kept_and_said(anchored):
    assert len(anchored.fit.attempts) >= 20
    assert "20 starts" in anchored.fit.message


def test_one_more_point_compiles_nothing(scan, gtf):
    """From 15 to 16 points, both padded to 16: the compiled calls are those of before."""
    compiled = []

    def heard(event, seconds, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    def longer(n):
        settings = {"Q2": np.append(scan.settings["Q2"], scan.settings["Q2"][:n])}
        columns = [{"x": np.append(v["x"], v["x"][:n])} for v in (scan.size, scan.error)]
        return beamfit.QuadScan(settings, {"Q2": "A"}, *columns)

    options = ({}, {"scenario": "calibration", "priors": PRIOR})
    for told in options:
        beamfit.fit_emittance(longer(1), gtf, **told)
    jax.monitoring.register_event_duration_secs_listener(heard)
    try:
        for told in options:
            beamfit.fit_emittance(longer(2), gtf, **told)
    finally:
        jax.monitoring.clear_event_listeners()
    assert compiled == []
