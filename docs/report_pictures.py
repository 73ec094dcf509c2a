"""Pictures of the report's figures 7 to 14 and 27 to 36, as docs/report_figures.md shows them.

All data are SIMULATED, as the report's were: truths are known and drawn.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[1]
MEASUREMENTS = ROOT / "measurements"
# The report's steps of the input: 0.5 s apart, a new one every 8.
APART, SAMPLES, EVERY = 0.5, 800, 8


def _run(physics, truth: Callable, noise: float):
    """A run of steps of the input whose parameters are `truth` of it."""
    from jax import numpy as jnp

    from beamfit.dynamics.record import Run
    from beamfit.dynamics.response import simulate

    random = np.random.default_rng(7)
    u = np.repeat(random.uniform(0.1, 2.9, SAMPLES // EVERY), EVERY)
    steps, states = jnp.full(SAMPLES, APART), jnp.zeros(physics.free_states)
    y = np.asarray(simulate(physics, jnp.asarray(truth(u)), jnp.asarray(u)[:, None], steps, states))
    y = y + noise * y.std() * random.normal(size=SAMPLES)
    return Run(APART * np.arange(SAMPLES), {"u": u}, {"y": y}, name="simulated")


def _first_order(u):
    """Eqs 6 and 7."""
    return np.stack([5 * np.tanh(u) + 0.5, 5 * np.tanh(u / 4) + 5], axis=-1)


def _second_order(u):
    """Eqs 9 to 11, as T, zeta and K."""
    return _by_lags(5 * np.tanh(u) + 0.5, 8 * np.tanh(np.exp(-u)), 5 * np.tanh(u / 4))


def _other_lag(u):
    """Eqs 17 to 19, likewise."""
    return _by_lags(5 * np.tanh(u) + 0.5, 8.5 - 8 * np.tanh(u**2 - 2 * u), 5 * np.tanh(u / 4))


def _by_lags(tau1, tau2, gain):
    time = np.sqrt(tau1 * tau2)
    return np.stack([time, (tau1 + tau2) / (2 * time), gain], axis=-1)


def _identified(model: str, truth: Callable, noise: float, title: str) -> Figure:
    """Curves of the parameters with their truth, and a close look at the output."""
    from beamfit.dynamics.fit import identify
    from beamfit.dynamics.response import PHYSICS

    run = _run(PHYSICS[model], truth, noise)
    fit = identify(run, model, "network", delay=0, offset=False)
    count = len(fit.curves)
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    above, below = figure.subfigures(2, 1)
    for axes, c, true in zip(
        above.subplots(1, count), fit.curves, truth(fit.curves[0].at).T, strict=True
    ):
        axes.plot(c.at, true, color="0.3", ls="--", label="truth")
        axes.plot(c.at, c.value, color="#1f5fa8", label="network")
        low, high = c.value - c.error, c.value + c.error
        axes.fill_between(c.at, low, high, color="#1f5fa8", alpha=0.25, lw=0)
        edge = 0.6 * np.ptp(true)
        axes.set(
            xlabel="u",
            title=f"{c.parameter}, {c.unit}",
            ylim=(true.min() - edge, true.max() + edge),
        )
        axes.title.set_size(9)
    axes.legend(frameon=False, fontsize=8)
    axes = below.subplots()
    near = slice(0, 160)
    axes.plot(run.time[near], run.outputs["y"][near], ".", color="0.6", ms=3, label="read")
    axes.plot(run.time[near], fit.fitted[0][near], color="#1f5fa8", label="free run of the model")
    axes.margins(y=0.25)
    axes.set(xlabel="time, s", ylabel="y, output's unit")
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper right")
    return figure


def figs_7_8() -> Figure:
    """First order, no noise."""
    return _identified("first-order", _first_order, 0.0, "figures 7, 8: first order, no noise")


def figs_9_10() -> Figure:
    """Second order, no noise."""
    return _identified("second-order", _second_order, 0.0, "figures 9, 10: second order, no noise")


def figs_11_13() -> Figure:
    """The other lag, with a tenth of the output's scatter as noise."""
    words = "figures 11 to 13: the lags of eqs 17 to 19, noise 0.1 of the output's scatter"
    return _identified("second-order", _other_lag, 0.1, words)


def fig_14() -> Figure:
    """The same with three times the output's scatter as noise."""
    words = "figure 14: the lags of eqs 17 to 19, noise of three times the output's scatter"
    return _identified("second-order", _other_lag, 3.0, words)


@cache
def _batches():
    from beamfit.dynamics.fedbatch import identify_batches
    from beamfit.io.run import read_run

    runs = [read_run(path) for path in sorted(MEASUREMENTS.glob("fedbatch_simulated_*.csv"))]
    return identify_batches(runs[:4], held=runs[4:])


def figs_31_33() -> Figure:
    """Measured and predicted outputs of a batch."""
    from beamfit.report.document import Picture, figure_of
    from beamfit.report.dynamics import draw_batch

    fit = _batches()
    return figure_of(Picture("", 5.6, lambda figure: draw_batch(fit, 0, figure), fit.runs[0].name))


def figs_34_36() -> Figure:
    """Growth and consumption against substrate, with the truth of the simulation."""
    fit = _batches()
    rates = runpy.run_path(str(MEASUREMENTS / "make_fedbatch.py"))["rates"]
    air = np.concatenate([run.inputs["air"] for run in fit.runs]).mean()
    figure = Figure(figsize=(6.4, 2.8), layout="constrained")
    chosen = [c for c in fit.curves if c.input == "substrate"]
    for axes, c in zip(np.ravel(figure.subplots(1, len(chosen))), chosen, strict=True):
        true = rates(c.at, air)[("mu_b", "mu_s").index(c.parameter)]
        axes.plot(c.at, true, color="0.3", ls="--", label="truth")
        axes.plot(c.at, c.value, color="#1f5fa8", label="network")
        low, high = c.value - c.error, c.value + c.error
        axes.fill_between(c.at, low, high, color="#1f5fa8", alpha=0.25, lw=0)
        axes.set(
            xlabel="substrate, g/L", ylabel=f"{c.parameter}, {c.unit}", ylim=(0, 1.3 * true.max())
        )
    axes.legend(frameon=False, fontsize=8)
    return figure


def figs_27_30() -> Figure:
    """Decays of a simulated shift with what first principles corrected by a network say of them."""
    import beamfit
    import beamfit.figures
    from beamfit.lifetime.ring_study import study_shift
    from beamfit.lifetime.study import Machine, study_record

    ring = ROOT / "lattices/spear3_2003.toml"
    machine = Machine(beamfit.read_ring(ring), beamfit.read_operation(ring))
    record = beamfit.read_decay_record(MEASUREMENTS / "spear3_shift_simulated.csv")
    decays = study_record(record, machine).decays
    return beamfit.figures.network(study_shift(decays, machine, network=True), decays)


FIGURES = (figs_7_8, figs_9_10, figs_11_13, fig_14, figs_27_30, figs_31_33, figs_34_36)
