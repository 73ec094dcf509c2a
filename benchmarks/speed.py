"""Processor time of beamfit and its peers on the same work, side by side: docs/speed.md.

    python -m benchmarks.speed [--work NAME]

Each subject yields sizes and, for each tool, what does the work once. Processor time, since it is
nearly the same on a busy machine; of all threads, so that nobody gains by taking more of them; the
least of several, since what disturbs a run only lengthens it.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import math
import os
import platform
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import emcee
import jax
import numpy as np

from beamfit import fit_sizes

from . import batch, sampling, verdict
from .decay_families import Decay, decay
from .league import decay_tools, scan_tools
from .league.scans import exact, spoiled

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "speed.md"
REPEATS, SECONDS = 3, 2.0  # of each work, and about how long at most
# A tool that takes longer than this, in s, is not given the next size.
PATIENCE = 1.0
# Files of a batch, from whose difference one more is told.
FILES = (512, 2560)
# What a peer's work imports; a run for the page stops where one is missing.
PEERS = ("pyemittance", "lmfit", "emcee", "casadi", "do_mpc", "at", "cpymad", "jax_sysid",
         "blackjax")  # fmt: skip
HEAD = """\
# Speed

Written by `make bench`, which runs beamfit and other programs one after the other. Numbers are
processor time of all threads, the smallest of several repeats, with one BLAS thread. Ratios are the
other program's time divided by that of beamfit: above 1 beamfit is faster. Warm means that nothing
compiles. The line above a table says if beamfit gives more (verdicts, correlated noise, errors).
"""
BUSY = "Others were at work: processor times are up to a half too long, ratios are good to that."
FIRST = """\
## First answers

A whole command or script in a fresh process, in seconds of processor time, and relative to the time
of `import jax, scipy.optimize` alone. "Kept" means with code compiled by an earlier run, "cold"
with nothing compiled.
"""


MANY = f"""\
## Files of a batch

What one more file of two planes costs `beamfit batch`, from runs of {FILES[0]} and {FILES[1]}
files. Elapsed time compares two workers with one only on an otherwise idle machine.
"""
AIMED = """\
## Targets

Targets and measured values. Files on two cores, and two workers over one, are calculated from
processor time, as on two idle cores.
"""


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


def least(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Least seconds of some calls; the first, which compiles, is left out."""
    gc.collect()  # a MAD-X that is done with ends here, and not while another is timed
    children = Path("/proc/self/task").glob("*/children")
    others = [Path(f"/proc/{pid}/schedstat") for one in children for pid in one.read_text().split()]
    work()
    found: list[float] = []
    while len(found) < repeats and (not found or sum(found) < SECONDS):
        begin = spent(others)
        own = work()
        took = spent(others) - begin
        found += own if isinstance(own, list) and own and isinstance(own[0], float) else [took]
    return min(found)


def asked(module, label: str, cases: list) -> Callable[[], object]:
    tool = module.TOOLS[label][0]
    return lambda: [tool(case) for case in cases]


def points(n: int) -> dict[str, Callable]:
    case = spoiled(exact, (0.02, 0.02), (n,), known=1.0)(np.random.default_rng(n))
    labels = ("pyemittance", "curve_fit", "lmfit", "sddsemitproc's method")
    own = {"beamfit": lambda: scan_tools.beamfit_fit(case)}
    return own | {label: asked(scan_tools, label, [case]) for label in labels}


def many(n: int) -> dict[str, Callable]:
    rng = np.random.default_rng(n)
    cases = [spoiled(exact, (0.02, 0.02), (9,), known=1.0)(rng) for _ in range(n)]
    labels = ("pyemittance", "curve_fit", "sddsemitproc's method")
    own = {"beamfit": lambda: scan_tools.by_beamfit(cases)}
    return own | {label: asked(scan_tools, label, cases) for label in labels}


def bare(n: int) -> dict[str, Callable]:
    rng = np.random.default_rng(n)
    t = verdict.truth(rng, 9)
    r11, r12 = t.line.rows(t.k1).T
    size = t.size * (1 + 0.02 * rng.standard_normal((n, 9)))
    design = np.stack([r11**2, 2 * r11 * r12, r12**2], 1)

    def by_hand():
        weight = 1 / (2 * size * 0.02 * size)
        rows = design * weight[..., None]
        normal = np.swapaxes(rows, 1, 2) @ rows
        sigma = np.linalg.solve(normal, np.einsum("kij,ki->kj", rows, weight * size**2)[..., None])
        value = np.sqrt(np.maximum(sigma[:, 0] * sigma[:, 2] - sigma[:, 1] ** 2, 0))
        return value, np.linalg.inv(normal)

    return {
        "beamfit": lambda: np.asarray(fit_sizes(r11, r12, size, 0.02 * size).covariance),
        "numpy by hand": by_hand,
    }


def readings(n: int) -> dict[str, Callable]:
    law = Decay(stated=1.0, readings=(n, n + 1))
    case = decay(law, np.random.default_rng(n))
    own = {"beamfit": lambda: decay_tools.beamfit_fit(case)}
    labels = ("curve_fit", "lmfit", "line through log I")
    return own | {label: asked(decay_tools, label, [case]) for label in labels}


def decays_at_once(n: int) -> dict[str, Callable]:
    from beamfit.lifetime.fit import fit_decays

    rng = np.random.default_rng(n)
    cases = [decay(Decay(stated=1.0, readings=(1000, 1001)), rng) for _ in range(n)]
    records = [case.record for case in cases]
    own = {
        "beamfit": lambda: fit_decays(records),
        "beamfit, a and b constant": lambda: fit_decays(records, law="constant"),
    }
    return own | {label: asked(decay_tools, label, cases) for label in ("curve_fit", "lmfit")}


def free(n: int) -> dict[str, Callable]:
    """Moré, Garbow and Hillstrom (1981), problem 28, a discrete boundary value problem."""
    import casadi
    import jax.numpy as jnp

    from beamfit.greybox.problem import Free, Problem, Record
    from beamfit.greybox.solve import solve

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
    from . import control

    both = {"beamfit": control.run_ours, "do-mpc": control.run_peer}
    return {name: lambda run=run: [float(sum(run("network", n)[2]))] for name, run in both.items()}


def elements(n: int) -> dict[str, Callable]:
    """R of a line of n elements, quadrupoles and drifts in turn."""
    import at
    from cpymad.madx import Madx

    import beamfit

    cell = [("Q", 0.1, 3.0), ("D", 0.4, 0.0), ("Q", 0.1, -3.0), ("D", 0.4, 0.0)]
    parts = [(f"{cell[i % 4][0]}{i}", *cell[i % 4][1:]) for i in range(n)]
    own = [beamfit.Quadrupole(m, s, k) if k else beamfit.Drift(m, s) for m, s, k in parts]
    line = beamfit.Beamline((*own, beamfit.Screen("S")), 135.0)
    theirs = [at.Quadrupole(m, s, k) if k else at.Drift(m, s) for m, s, k in parts]
    ring = at.Lattice(theirs, energy=135e6)
    mad = Madx(stdout=False)
    where = np.cumsum([s for _, s, _ in parts]) - [s / 2 for _, s, _ in parts]
    mad.input("beam, particle=electron, energy=0.135; option, -echo, -info, -warn;")
    mad.input(f"line: sequence, l={sum(s for _, s, _ in parts)};")
    for (m, s, k), place in zip(parts, where, strict=True):
        if k:
            mad.input(f"{m}: quadrupole, l={s}, k1={k}, at={place};")
    mad.input("endsequence; use, sequence=line;")
    return {
        "beamfit": lambda: np.asarray(line.matrix().x),
        "pyAT": lambda: at.find_m44(ring, orbit=np.zeros(6)),
        "MAD-X (twiss)": lambda: mad.twiss(betx=1, bety=1, rmatrix=True),
    }


def slices(n: int) -> dict[str, Callable]:
    """Piwinski's rate at n places of SPEAR3."""
    import at

    from beamfit.io.ring import ring_from_pyat
    from beamfit.lifetime.mechanisms import piwinski_rate
    from beamfit.lifetime.ring import population

    from . import spear3_lattice

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
    return {
        "beamfit": lambda: float(piwinski_rate(thin, electrons, length, 0.03)),
        "pyAT": lambda: at.get_lifetime(
            flat, ring.emittance_y, 0.5 / 280, momap=momenta, refpts=places,
            interpolate=False, **beam,
        ),
    }  # fmt: skip


def samples(n: int) -> dict[str, Callable]:
    """A first-order lag from n samples with 2 % of noise."""
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
        from jax_sysid.models import LinearModel

        model = LinearModel(1, 1, 1, seed=0)
        model.optimization(adam_epochs=0, lbfgs_epochs=1000, iprint=-1)
        model.fit(y[:, None], u[:, None])

    return {
        "beamfit": lambda: identify(run, "first-order", delay=0, offset=False),
        "jax-sysid": peer,
    }


def effective(case: sampling.Case, n: int) -> dict[str, Callable]:
    """Seconds for n thousand effective samples of the slowest number."""
    given, moves = (case.start, case.spread, 1, 1500), emcee.moves.DEMove()
    one, nuts = partial(sampling.alone, case.log_prob), sampling.compiled(case)
    many = partial(sampling.plain, case.log_prob, *given, vectorize=True)
    made = {
        "beamfit": lambda: sampling.ours(case.sample, 1)[0],
        "emcee": lambda: sampling.plain(one, *given)[0],
        "emcee, vectorised": lambda: many()[0],
        "emcee, 256 walkers": lambda: many(walkers=256)[0],
        "emcee, differential evolution": lambda: many(moves=moves)[0],
        "NUTS, compiled": lambda: nuts(1)[0],
    }
    return {name: lambda rate=rate: [1e3 * n / rate()] for name, rate in made.items()}


PEERS_SAMPLE = (
    "The slowest number counts, by emcee's autocorrelation time. emcee as it comes, 32 walkers and "
    "a scalar log-probability; then all walkers in one call. NUTS is blackjax's in one compiled "
    "loop of JAX, whitened, its step adapted beforehand at no cost."
)
WORK = (
    Work("Points of a scan", "points", "One scan to an emittance; beamfit averages over noises and "
         "judges, the peers fit.", (10, 100), points),
    Work("Scans, judged", "scans", "Nine points each, each of a line of its own, in one call.",
         (1, 16, 128), many),
    Work("Scans, fit alone", "scans", "Nine points each, all of one line, in one call of "
         "`fit_sizes`: σ and its covariance; by hand the weighted normal equations, batched.",
         (10_000,), bare),
    Work("Readings of a decay", "readings", "a, b and lifetime from a record; beamfit looks for "
         "refills, and averages over laws and noises.", (100, 1000), readings),
    Work("Decays at once", "decays of 1000 readings", "In one call of `fit_decays`.",
         (1, 10), decays_at_once),
    Work("Effective samples of a scan", "thousand", f"σ of the 14-point scan, the noise averaged "
         f"over. {PEERS_SAMPLE}", (1,), lambda n: effective(sampling.scan(), n)),
    Work("Effective samples of a decay", "thousand", f"First current, a and b of a decay of 1 000 "
         f"readings with known noise. {PEERS_SAMPLE}", (1,),
         lambda n: effective(sampling.decay(), n)),
    Work("Elements of a line", "elements", "Transfer matrix; MAD-X gives Twiss as well.",
         (10, 1000), elements),
    Work("Slices of a ring", "slices", "Touschek lifetime (Piwinski).", (10, 100), slices),
    Work("Samples of a response", "samples", "A first order identified; beamfit adds errors, "
         "residual tests and a verdict, jax-sysid is given 1000 steps of L-BFGS.",
         (100, 1000), samples),
    Work("Steps of a controller", "steps", "The closed loop of benchmarks/control.py, lag and gain "
         "by a network.", (30,), steps),
    Work("Free numbers of a formulation", "free numbers", "A discrete boundary value problem as "
         "least squares (Moré, Garbow, Hillstrom 28); beamfit adds rank, errors and its own test "
         "of the optimum.", (2, 20, 200), free),
)  # fmt: skip


def refuse_if_missing() -> None:
    """Stop where a peer is not installed."""
    for name in PEERS:
        try:
            importlib.import_module(name)
        except ImportError as error:
            said = f"speed: {name} is not installed ({error}); make .venv/bench"
            raise SystemExit(said) from None


def measured(work: Work, repeats: int = REPEATS) -> Iterator[tuple[int, dict[str, float]]]:
    """Least seconds of each tool, size by size."""
    slow: set[str] = set()
    for size in work.sizes:
        found = {}
        for tool, does in work.doing(size).items():
            if tool not in slow:
                found[tool] = least(does, repeats)
                slow |= {tool} if found[tool] > PATIENCE else set()
        print(work.name, size, {k: f"{v:.3g} s" for k, v in found.items()}, flush=True)
        yield size, found


def table(work: Work, rows: list[tuple[int, dict[str, float]]]) -> str:
    """Milliseconds of beamfit, and each peer's time over it."""
    peers = [tool for tool in rows[0][1] if tool != "beamfit"]
    lines = [[work.unit, "beamfit, ms", *peers], ["---"] * (2 + len(peers))]
    for size, found in rows:
        ratios = [f"{found[p] / found['beamfit']:.2g}" if p in found else "–" for p in peers]
        lines.append([f"{size}", f"{1e3 * found['beamfit']:.3g}", *ratios])
    if len(rows) > 1:
        lines.append(["growth", *(growth(rows, tool) for tool in ("beamfit", *peers))])
    shown = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"## {work.name}\n\n{work.words}\n\n{shown}\n"


def growth(rows: list[tuple[int, dict[str, float]]], tool: str) -> str:
    """p of time ~ size^p between the last two sizes that the tool was given."""
    given = [(size, found[tool]) for size, found in rows if tool in found][-2:]
    if len(given) < 2:
        return "–"
    (small, short), (large, long) = given
    return f"{math.log(long / short) / math.log(large / small):.2g}"


def command(*words: str, cold: bool = False) -> float:
    """Processor seconds of a process, which keeps the bytecode of modules, as Python does."""
    kept = {"PYTHONDONTWRITEBYTECODE": ""}
    if cold:
        kept["JAX_ENABLE_COMPILATION_CACHE"] = "false"
    with subprocess.Popen([sys.executable, *words], stdout=subprocess.DEVNULL,
                          env=os.environ | kept) as process:  # fmt: skip
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{words} ended with {process.returncode}")
    return used.ru_utime + used.ru_stime


def first_answers(repeats: int = 5) -> tuple[str, dict[str, float]]:
    """Seconds of whole processes, the least of several, told, and over those of an import alone."""
    scan, lattice = ROOT / "measurements/lcls_otr2.csv", ROOT / "lattices/lcls_otr2.toml"
    main = ["-c", "from beamfit.cli import main; main()"]
    case = decay(Decay(readings=(1000, 1001)), np.random.default_rng(0)).record
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "decay.csv"
        rows = np.column_stack([case.time, case.current])
        np.savetxt(record, rows, delimiter=",", header="time_s,beam_current_mA", comments="")
        script = f"import beamfit; line = beamfit.load_lattice({str(lattice)!r}); "
        script += f"print(beamfit.fit_emittance(beamfit.read_quad_scan({str(scan)!r}), line))"
        emittance = [*main, "emittance", str(scan), "--lattice", str(lattice)]
        lifetime = [*main, "lifetime", str(record)]
        asked = {
            "import jax, scipy.optimize": ["-c", "import jax, scipy.optimize"],
            "beamfit --help": [*main, "--help"],
            "beamfit emittance, kept": emittance,
            "a script with one fit, kept": ["-c", script],
            "beamfit lifetime, kept": lifetime,
        }
        found = {}
        for name, words in asked.items():
            command(*words)
            found[name] = min(command(*words) for _ in range(repeats))
        for name, words in (("emittance", emittance), ("lifetime", lifetime)):
            found[f"beamfit {name}, cold"] = command(*words, cold=True)
    base = found["import jax, scipy.optimize"]
    lines = ["| process | s | over the import |", "|---|---|---|"]
    lines += [f"| {name} | {s:.2f} | {s / base:.2f} |" for name, s in found.items()]
    print(*lines, sep="\n", flush=True)
    told = FIRST + "\n" + "\n".join(lines) + "\n"
    return told, {name: s / base for name, s in found.items()}


def many_files() -> tuple[str, dict[str, float]]:
    """Seconds that a further file costs `beamfit batch`, in one process and in two workers."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        batch.write_scans(Path(folder) / "scans", FILES[1])
        scans = sorted((Path(folder) / "scans").rglob("*.csv"))
        for name, more in (("one process", ()), ("two workers", ("--workers", "2"))):
            costs = [batch.measured(scans[:n], Path(folder) / "out.csv", *more) for n in FILES]
            less, most = (np.array([c.processor, c.wall]) for c in costs)
            found[name] = tuple((most - less) / (FILES[1] - FILES[0]))
            print(name, costs, flush=True)
    lines = ["| run | ms of processor | ms on the clock |", "|---|---|---|"]
    lines += [f"| {name} | {1e3 * p:.2f} | {1e3 * w:.2f} |" for name, (p, w) in found.items()]
    one, two = (found[name][0] for name in ("one process", "two workers"))
    told = MANY + "\n" + "\n".join(lines) + "\n"
    return told, {"files": 1e5 * two / 2, "workers": 2 * one / two}


class Target(NamedTuple):
    """A figure to reach: how it comes from what was measured, and why it is missed."""

    name: str
    unit: str
    aim: float
    found: Callable[[dict], float]
    why: str = ""
    most: bool = True  # the figure is at most the aim, else at least


def each(work: str, size: int) -> Callable[[dict], float]:
    """Milliseconds of beamfit for one of so many."""
    return lambda every: 1e3 * dict(every[work])[size]["beamfit"] / size


def over_best(work: str, word: str) -> Callable[[dict], float]:
    """The time of the best of some peers over beamfit's."""

    def found(every: dict) -> float:
        ((_, told),) = every[work]
        return min(s for tool, s in told.items() if tool.startswith(word)) / told["beamfit"]

    return found


def by_name(table: str, name: str) -> Callable[[dict], float]:
    return lambda every: every[table][name]


TRACED = (
    "beamfit's own modules and SciPy's that they need are imported, and JAX traces and lowers the "
    "line anew in every process"
)
BUDGET = f"{TRACED}, and so it does for the budget of the first screen"
COMPILED = "the programs of line and decay are compiled"
DRAWN = (
    "every scan has 1 536 draws by 13 sizes of the noise for a beam, and its rivals' evidence, in "
    "NumPy"
)
NOISES = (
    "89 noises, 33 exponents and some 6 000 draws are averaged over for each record; a and b taken "
    "as constant cost far less"
)
TARGETS = (
    Target("first answer of a command, kept", "× import", 1.5,
           by_name("first", "beamfit emittance, kept"), BUDGET),
    Target("first answer of a script, kept", "× import", 1.3,
           by_name("first", "a script with one fit, kept"), TRACED),
    Target("first emittance, cold", "× import", 3.0,
           by_name("first", "beamfit emittance, cold"), COMPILED),
    Target("first lifetime, cold", "× import", 3.0,
           by_name("first", "beamfit lifetime, cold"), COMPILED),
    Target("one of 10 000 scans, fit alone", "ms", 0.004, each("Scans, fit alone", 10_000),
           "NumPy by hand is faster still: arrays go to JAX and back, and a check of rank stands "
           "beside"),
    Target("one of 128 scans, judged", "ms", 0.5, each("Scans, judged", 128), DRAWN),
    Target("one of 10 decays of 1 000 readings, judged", "ms", 0.5, each("Decays at once", 10),
           NOISES),
    Target("100 000 files on two cores", "s", 150.0, by_name("many", "files"), DRAWN),
    Target("two workers over one", "×", 1.7, by_name("many", "workers"),
           "workers are sent files and send rows", most=False),
    *(Target(f"effective samples of a {what}, over the best emcee", "×", 10.0,
             over_best(f"Effective samples of a {what}", "emcee"),
             "with all walkers in one call, or moves by differential evolution, emcee does little "
             "work in Python for a draw", most=False) for what in ("scan", "decay")),
    *(Target(f"effective samples of a {what}, over compiled NUTS", "×", 2.0,
             over_best(f"Effective samples of a {what}", "NUTS"),
             "three numbers are few, and NUTS moves far in each step", most=False)
      for what in ("scan", "decay")),
)  # fmt: skip


def plainly(value: float, digits: int) -> str:
    """So many digits, without a power of ten."""
    return f"{float(f'{value:.{digits}g}'):g}"


def targets(every: dict) -> str:
    """What was aimed at beside what was reached, and why where it was not."""
    lines = ["| what | reached | target | why not |", "|---|---|---|---|"]
    for t in TARGETS:
        value = t.found(every)
        met = value <= t.aim if t.most else value >= t.aim
        far = value / t.aim if t.most else t.aim / value
        why = "reached" if met else f"missed by a factor {plainly(far, 2)}: {t.why}"
        sign = "≤" if t.most else "≥"
        lines.append(f"| {t.name} | {plainly(value, 3)} {t.unit} | {sign} {t.aim:g} | {why} |")
    return AIMED + "\n" + "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed", description=__doc__)
    parser.add_argument("--work", default="", help="works whose name holds this; no page")
    only = parser.parse_args().work
    refuse_if_missing()
    warnings.simplefilter("ignore")
    if only:
        for work in WORK:
            if only in work.name:
                print(table(work, list(measured(work))))
        return
    versions = f"Python {platform.python_version()}, JAX {jax.__version__}, numpy {np.__version__}"
    load = os.getloadavg()[0]
    made = f"Measured with {versions}, {os.cpu_count()} processors, load {load:.0f}.\n"
    if load > 1.5:
        made += f"{BUSY}\n"
    every: dict[str, Any] = {}
    told, every["first"] = first_answers()
    files, every["many"] = many_files()
    tables = []
    for work in WORK:
        every[work.name] = list(measured(work))
        tables.append(table(work, every[work.name]))
    PAGE.write_text("\n".join([HEAD, made, targets(every), told, files, *tables]))


if __name__ == "__main__":
    main()
