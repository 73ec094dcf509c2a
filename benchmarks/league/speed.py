"""Processor time of the same work by beamfit and its peers, as the work grows by decades.

Each subject yields sizes and, for each tool, what does the work once. Processor time, since it is
the same on a busy machine; of all threads, so that nobody gains by taking more of them.
"""

from __future__ import annotations

import gc
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from beamfit import fit_sizes

from . import decay_tools, decays, scan_tools, scans

REPEATS, SECONDS = 7, 2.0  # of each work, and about how long at most
MINUTE = 60.0  # s; what takes longer is measured once


class Work(NamedTuple):
    """What is compared: `doing(size)` gives each tool's work, or its own seconds a list long."""

    name: str
    unit: str
    words: str
    sizes: tuple[int, ...]
    doing: Callable[[int], dict[str, Callable[[], object]]]


def spent(others: list[Path]) -> float:
    """Processor time of this process and of those it works through, as MAD-X is asked, s."""
    ns = sum(int(one.read_text().split()[0]) for one in others)
    return time.process_time() + 1e-9 * ns


def timed(work: Callable[[], object]) -> list[float]:
    """Least, median and most seconds of some calls; the first, which compiles, is left out."""
    gc.collect()  # a MAD-X that is done with ends here, and not while another is timed
    children = Path("/proc/self/task").glob("*/children")
    others = [Path(f"/proc/{pid}/schedstat") for one in children for pid in one.read_text().split()]
    begin = spent(others)
    work()
    least = 3 if spent(others) - begin < MINUTE else 1
    found: list[float] = []
    while len(found) < least or (len(found) < REPEATS and sum(found) < SECONDS):
        begin = spent(others)
        own = work()
        took = spent(others) - begin
        found += own if isinstance(own, list) and own and isinstance(own[0], float) else [took]
    return [min(found), statistics.median(found), max(found)]


def points(n: int) -> dict[str, Callable]:
    scan = scans.scan(np.random.default_rng(n), n=n)
    tools = {"beamfit": lambda: scan_tools.beamfit_fit(scan)}
    for name in ("pyemittance", "scipy curve_fit", "cheetah + curve_fit", "lmfit"):
        tools[name] = lambda tool=scan_tools.TOOLS[name][0]: tool(scan)
    return tools


def many(n: int) -> dict[str, Callable]:
    rng = np.random.default_rng(n)
    given = [scans.scan(rng, n=9) for _ in range(n)]
    (r11, r12), size = given[0].rows.T, np.array([scan.size for scan in given])
    tools = {
        "beamfit": lambda: scan_tools.by_beamfit(given),
        "beamfit's fit_sizes": lambda: np.asarray(
            fit_sizes(r11, r12, size, 0.02 * size).covariance
        ),
    }
    for name in ("pyemittance", "scipy curve_fit", "sddsemitproc's method"):
        tools[name] = lambda tool=scan_tools.TOOLS[name][0]: [tool(scan) for scan in given]
    return tools


def readings(n: int) -> dict[str, Callable]:
    from beamfit.lifetime.fit import fit_decay
    from beamfit.lifetime.record import DecayRecord

    case = decays.decay(np.random.default_rng(n), n=n, stated=1.0)
    record = DecayRecord(case.time, case.current, case.error)
    tools = {"beamfit": lambda: fit_decay(record)}
    for name in ("scipy curve_fit", "lmfit", "line through log I"):
        tools[name] = lambda tool=decay_tools.TOOLS[name][0]: tool(case)
    return tools


def free(n: int) -> dict[str, Callable]:
    """Moré, Garbow and Hillstrom (1981), problem 28, a discrete boundary value problem."""
    import casadi
    import jax.numpy as jnp

    from beamfit.greybox.problem import Problem
    from beamfit.greybox.solve import solve
    from beamfit.greybox.terms import Free, Record

    h = 1 / (n + 1)
    t = h * np.arange(1, n + 1)

    def residuals(model, t):
        x = model["x"]
        beside = jnp.concatenate([x[1:], jnp.zeros(1)]) + jnp.concatenate([jnp.zeros(1), x[:-1]])
        return 2 * x - beside + h**2 * (x + t + 1) ** 3 / 2

    record = Record("rows", residuals, t, np.zeros(n), error=1.0)
    problem = Problem({"x": t * (t - 1)}, [Free("x", -10, 10)], [record])
    x = casadi.SX.sym("x", n)
    beside = casadi.vertcat(x[1:], 0) + casadi.vertcat(0, x[:-1])
    r = 2 * x - beside + h**2 * (x + t + 1) ** 3 / 2
    options = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-9}
    ipopt = casadi.nlpsol("s", "ipopt", {"x": x, "f": casadi.sumsqr(r)}, options)
    return {
        "beamfit": lambda: solve(problem),
        "CasADi + IPOPT": lambda: ipopt(x0=t * (t - 1), lbx=-10, ubx=10),
    }


def steps(n: int) -> dict[str, Callable]:
    import control

    control.time = SimpleNamespace(perf_counter=time.process_time)
    both = {"beamfit": control.run_ours, "do-mpc": control.run_peer}
    return {name: lambda run=run: [float(sum(run("network", n)[2]))] for name, run in both.items()}


def elements(n: int) -> dict[str, Callable]:
    """R of a line of n elements, quadrupoles and drifts in turn."""
    import at
    import cheetah
    import torch
    from cpymad.madx import Madx

    import beamfit

    torch.set_default_dtype(torch.float64)
    cell = [("Q", 0.1, 3.0), ("D", 0.4, 0.0), ("Q", 0.1, -3.0), ("D", 0.4, 0.0)]
    parts = [(f"{cell[i % 4][0]}{i}", *cell[i % 4][1:]) for i in range(n)]
    line = beamfit.Beamline(
        (
            *(
                beamfit.Quadrupole(m, s, k) if k else beamfit.Drift(m, s)
                for m, s, k in parts
            ),
            beamfit.Screen("S"),
        ),
        135.0,
    )  # fmt: skip
    ring = at.Lattice(
        [at.Quadrupole(m, s, k) if k else at.Drift(m, s) for m, s, k in parts], energy=135e6
    )
    value = torch.tensor
    segment = cheetah.Segment(
        [
            cheetah.Quadrupole(value(s), value(k)) if k else cheetah.Drift(value(s))
            for _, s, k in parts
        ]
    )
    energy, electron = value(135e6), cheetah.Species("electron")
    mad = Madx(stdout=False)
    where = np.cumsum([s for _, s, _ in parts]) - [s / 2 for _, s, _ in parts]
    mad.input("beam, particle=electron, energy=0.135; option, -echo, -info, -warn;")
    mad.input(f"line: sequence, l={sum(s for _, s, _ in parts)};")
    for (m, s, k), at_ in zip(parts, where, strict=True):
        if k:
            mad.input(f"{m}: quadrupole, l={s}, k1={k}, at={at_};")
    mad.input("endsequence; use, sequence=line;")
    return {
        "beamfit": lambda: np.asarray(line.matrix().x),
        "pyAT": lambda: at.find_m44(ring, orbit=np.zeros(6)),
        "cheetah": lambda: segment.first_order_transfer_map(energy, electron),
        "MAD-X (twiss)": lambda: mad.twiss(betx=1, bety=1, rmatrix=True),
    }


def slices(n: int) -> dict[str, Callable]:
    """Piwinski's rate at n places of SPEAR3; xfields is asked for the integrals alone."""
    import at
    import spear3_lattice
    from lifetime import piwinski_rate, population, ring_from_pyat
    from xfields.touschek.piwinski import piwinski_integral

    lattice = spear3_lattice.build(0.09)
    ring = ring_from_pyat(lattice, coupling=0.002)
    chosen = np.linspace(0, ring.optics.weight.size - 1, n).astype(int)
    optics = ring.optics._replace(**{
        name: np.asarray(part)[chosen]
        for name, part in ring.optics._asdict().items()
        if np.shape(part) == np.shape(ring.optics.weight)
    })  # fmt: skip
    thin = ring._replace(optics=optics)
    electrons, length = population(ring, 500 / 280), 4.97e-3
    flat = lattice.disable_6d(copy=True)
    places = np.flatnonzero([element.Length > 0 for element in flat])
    places = places[np.linspace(0, places.size - 1, n).astype(int)]
    beam = {"emitx": ring.emittance_x, "sigs": length, "sigp": ring.energy_spread}
    momenta = np.tile([0.03, -0.03], (n, 1))
    b1 = np.random.default_rng(0).uniform(1, 20, n)
    return {
        "beamfit": lambda: float(piwinski_rate(thin, electrons, length, 0.03)),
        "pyAT": lambda: at.get_lifetime(
            flat, ring.emittance_y, 0.5 / 280, momap=momenta, refpts=places,
            interpolate=False, **beam,
        ),
        "xfields": lambda: [piwinski_integral(9e-4, b, 0.9 * b) for b in b1] and None,
    }  # fmt: skip


def samples(n: int) -> dict[str, Callable]:
    """A first-order lag from n samples with 2 % of noise."""
    from jax_sysid.models import LinearModel

    from beamfit.dynamics.fit import identify
    from beamfit.dynamics.record import Run

    rng = np.random.default_rng(n)
    u = np.repeat(rng.uniform(0.1, 2.9, n // 8 + 1), 8)[:n]
    x = np.zeros(n)
    for k in range(n - 1):
        x[k + 1] = 0.9 * x[k] + 0.2 * u[k]
    y = x + 0.02 * x.std() * rng.normal(size=n)
    run = Run(0.5 * np.arange(n), {"u": u}, {"y": y})

    def peer():
        model = LinearModel(1, 1, 1, seed=0)
        model.optimization(adam_epochs=0, lbfgs_epochs=1000, iprint=-1)
        model.fit(y[:, None], u[:, None])

    return {
        "beamfit": lambda: identify(run, "first-order", delay=0, offset=False),
        "jax-sysid": peer,
    }


WORK = (
    Work("Points of a scan", "points", "One scan to an emittance with its error.",
         (10, 100, 1000, 10_000), points),
    Work("Scans", "scans", "Of nine points each, all of one line; beamfit judges each, its "
         "fit_sizes alone does what the peers do.", (1, 10, 100, 1000), many),
    Work("Readings of a decay", "readings", "a, b and lifetime with errors, and what the peers "
         "lack: correlated residuals, constancy of a and b, a verdict.",
         (100, 1000, 10_000, 100_000), readings),
    Work("Free numbers of a formulation", "free numbers", "A discrete boundary value problem as "
         "least squares (Moré, Garbow, Hillstrom 28); beamfit adds rank, errors and its own test "
         "of the optimum, with dense matrices, where IPOPT's are sparse.",
         (2, 20, 200, 2000), free),
    Work("Steps of a controller", "steps", "The closed loop of benchmarks/control.py, lag and gain "
         "by a network.", (3, 30, 300), steps),
    Work("Elements of a line", "elements", "Transfer matrix of a line; MAD-X gives Twiss as well.",
         (10, 100, 1000, 10_000), elements),
    Work("Slices of a ring", "slices", "Touschek lifetime (Piwinski); of xfields the integrals.",
         (10, 100, 1000), slices),
    Work("Samples of a response", "samples", "A first order identified; beamfit adds errors, "
         "residual tests and a verdict, jax-sysid is given 1000 steps of L-BFGS.",
         (100, 1000, 10_000), samples),
)  # fmt: skip
# Beyond this nothing is waited for: the next size of such a tool is left out.
PATIENCE = 4.0


def measured(only: str) -> Iterator[dict]:
    """One subject after another, as the results hold it."""
    warnings.simplefilter("ignore")
    for name, unit, words, sizes, doing in WORK:
        if only not in name:
            continue
        found: dict[str, dict] = {}
        slow: set[str] = set()
        for size in sizes:
            times = {}
            for tool, work in doing(size).items():
                if tool in slow:
                    continue
                times[tool] = [float(f"{t:.4g}") for t in timed(work)]
                if times[tool][1] > PATIENCE / 10:
                    slow.add(tool)
            print(name, size, times, flush=True)
            found[str(size)] = times
            if "beamfit" in slow:
                break
        yield {name: {"unit": unit, "words": words, "sizes": found}}
