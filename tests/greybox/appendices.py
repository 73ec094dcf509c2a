"""The report's Appendices A, B and C as problems, on SIMULATED scans.

The report's 14 measured points (fitdata.csv) were never published. The scans here are simulated
from the beam matrix of its Table 2, first row, with the transport matrices of
shared/reference/gtf.json (an independent product of the six matrices with the appendix constants).
"""

import jax.numpy as jnp
import numpy as np

from beamfit.greybox.gains import certified_gain, gain_at
from beamfit.greybox.mlp import dense
from beamfit.greybox.problem import Free, Problem, Record

# gtf.json: A_T, and B_T in m, for currents 0, 0.3, ... 3.9 A.
CURRENTS = np.linspace(0.0, 3.9, 14)
A_T = np.array([
    0.7079573565117145, 0.45284362590497446, 0.1985484327253242, -0.05492941042766771,
    -0.30759108985947703, -0.5594377907813614, -0.8104706973110976, -1.060690992473716,
    -1.310099858202236, -1.5586984753384012, -1.8064880236334164, -2.053469681748676,
    -2.2996446272565065, -2.5450140366408918,
])  # fmt: skip
B_T = np.array([
    2.0951113356746487, 2.03872471715192, 1.9825040308237039, 1.9264490432716872,
    1.8705595212894364, 1.814835231882254, 1.7592759422670394, 1.7038814198721461,
    1.6486514323372432, 1.5935857475131725, 1.5386841334618073, 1.4839463584559147,
    1.4293721909790107, 1.3749613997252235,
])  # fmt: skip
SIGMA = (2.62035, 1.55237, 1.40828)  # Table 2, "Known A_T & B_T", in 1e-8 SI
SPEC = np.array([[0.953728998305, 0.418879020479], [-0.682448955752, 0.748783408240]])


def size(sigma, a, b):
    """Beam size in µm from the beam matrix in 1e-8 SI (eq 37)."""
    s11, s12, s22 = sigma
    return 100.0 * (a**2 * s11 + 2 * a * b * s12 + b**2 * s22) ** 0.5


def simulated_scan(seed, relative_error=0.02):
    """SIMULATED sizes in µm and their errors."""
    exact = size(SIGMA, A_T, B_T)
    error = relative_error * exact
    return exact + error * np.random.default_rng(seed).normal(size=14), error


def squared(sigma, a, b):
    """Squared size in µm²."""
    return 1e4 * (a**2 * sigma["s11"] + 2 * a * b * sigma["s12"] + b**2 * sigma["s22"])


def squared_record(predict, data, scan):
    """The residual `error_linear`: squares compared, with error 2 * size * error."""
    measured, error = scan
    return Record("scan", predict, data, measured**2, 2 * measured * error)


def predict_known(model, data):
    return squared(model, *data)


def appendix_a(scan):
    """Known transport; the three elements of the beam matrix free."""
    free = [Free(name, 0.0, 10.0) for name in ("s11", "s12", "s22")]
    start = {"s11": 5.0, "s12": 5.0, "s22": 5.0}
    return Problem(start, free, [squared_record(predict_known, (A_T, B_T), scan)])


def predict_network(model, currents):
    ab = jnp.stack([model["map"].values(jnp.array([c])) for c in np.asarray(currents)])
    return squared(model, ab[:, 0], ab[:, 1])


def predict_network_points(model, currents):
    import jax

    ab = jax.vmap(model["map"].values)(currents[:, None])
    return squared(model, ab[:, 0], ab[:, 1])


# The margins of Appendix B: 1.2 dA/dc + 0.01 <= 0, 5.4 dB/dc + 0.01 <= 0.
LIMITS = {"A": -1e-2 / 1.2, "B": -1e-2 / 5.4}


def point_constraints():
    """28 gain constraints, at the 14 currents."""
    points = CURRENTS[:, None]
    return [gain_at("map", out, ["c"], points, upper=top) for out, top in LIMITS.items()]


def certified_constraints(cells=32):
    """The same for every current from 0 to 3.9 A."""
    return [
        c
        for out, top in LIMITS.items()
        for c in certified_gain("map", out, "c", ([0.0], [3.9]), cells, upper=top)
    ]


def appendix_b(scan, constraints):
    """A 1-5-2 tanh network for A_T and B_T, its gains limited, and the beam matrix."""
    model = {"s11": 2.635, "s12": 1.575, "s22": 1.435, "map": dense(["c"], ["A", "B"], spread=0.01)}
    free = [
        Free("s11", 2.0, 3.0, (2.63, 2.64)),
        Free("s12", 1.0, 2.0, (1.57, 1.58)),
        Free("s22", 1.0, 2.0, (1.43, 1.44)),
        Free("map", -10.0, 10.0, (-0.01, 0.01), nuisance=True),
    ]
    record = squared_record(predict_network_points, CURRENTS, scan)
    return Problem(model, free, [record], constraints=constraints)


def transport(model, current, np=jnp):
    """A_T and B_T from the calibration, eqs 20-35 with the appendix constants."""
    length, drift1, drift2 = 0.07677, 1.873 - 0.07677 / 2, 0.4191
    k1 = np.sqrt(model["int_q3"] / 30.50)
    k2 = np.sqrt((model["slope_q4"] * current + model["int_q4"]) / 30.50)
    between = 4.36 - 4.173 - length
    c1, s1 = np.cosh(k1 * length), np.sinh(k1 * length)
    c2, s2 = np.cos(k2 * length), np.sin(k2 * length)
    # First column and second column after the defocusing quadrupole and the drift.
    a, c = c1 + between * k1 * s1, k1 * s1
    b, d = s1 / k1 + between * c1, c1
    a, c = c2 * a + s2 / k2 * c, -k2 * s2 * a + c2 * c
    b, d = c2 * b + s2 / k2 * d, -k2 * s2 * b + c2 * d
    row = SPEC[0] + drift2 * SPEC[1]
    return row[0] * (a + drift1 * c) + row[1] * c, row[0] * (b + drift1 * d) + row[1] * d


def predict_calibrated(model, currents):
    a, b = transport(model, currents)
    # sigma = L L^T keeps the beam matrix positive; as printed, 12 of 20 random starts are NaN.
    x, y = a * model["l11"] + b * model["l21"], b * model["l22"]
    return 100.0 * jnp.sqrt(x**2 + y**2)


def appendix_c(scan):
    """Slope and intercept of the quadrupole's calibration free besides the beam matrix."""
    model = {"l11": 1.6, "l21": 1.0, "l22": 0.7, "slope_q4": 167.23, "int_q4": 43.17}
    model |= {"slope_q3": 160.87, "int_q3": 49.0}
    free = [
        Free("l11", 1e-3, 100.0, (0.1, 3.16)),
        Free("l21", 0.0, 100.0, (0.0, 3.16)),
        Free("l22", 1e-3, 100.0, (0.1, 3.16)),
        Free("slope_q4", 147.23, 187.23, (147.23, 187.23)),
        Free("int_q4", 23.17, 63.17, (23.17, 63.17)),
        Free("slope_q3", 160.87, 160.87),
        Free("int_q3", 49.0, 49.0),
    ]
    return Problem(model, free, [Record("scan", predict_calibrated, CURRENTS, *scan)])
