"""How well are the rates of a fed-batch process found? python benchmarks/fedbatch.py [FOLDER]

SIMULATED batches (measurements/fedbatch_simulated_*.csv): four identify the rates, the fifth is
held back; errors of the rates where the batches were, what the titre hangs on, two feed profiles
and the planned one against the plant. With a folder the pictures (report figs 31 to 36) go there.
"""

from __future__ import annotations

import runpy
import sys
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import beamfit
from beamfit.dynamics.fedbatch import identify_batches, rank_inputs
from beamfit.dynamics.feed import best_feed, predict
from beamfit.io.run import read_run

PLACE = Path(__file__).resolve().parents[1] / "measurements"
START, REST = (1.0, 8.0, 4.0, 0.0), {"feed_substrate": 200.0, "air": 1.0}
TITRE, PRODUCT = 2.5, 20.0


def against_truth(fit, rates):
    """Relative errors and pulls of each curve, where batches were and the rate is above 5 %."""
    air = np.concatenate([run.inputs["air"] for run in fit.runs]).mean()
    substrate = np.concatenate([x[:, 1] for x in fit.courses]).mean()
    for c in fit.curves:
        true = rates(*((c.at, air) if c.input == "substrate" else (substrate, c.at)))
        true = true[("mu_b", "mu_s").index(c.parameter)]
        seen = c.visited & (true > 0.05 * true.max())
        off, pull = ((c.value - true) / of for of in (true, c.error))
        print(
            f"{c.parameter} by {c.input}: largest error {100 * np.abs(off[seen]).max():.1f} %, "
            f"rms {100 * np.sqrt(np.mean(off[seen] ** 2)):.1f} %, rms pull "
            f"{np.sqrt(np.mean(pull[seen] ** 2)):.2f}, visited {100 * c.visited.mean():.0f} %"
        )


def main() -> None:
    made, began = runpy.run_path(str(PLACE / "make_fedbatch.py")), time.process_time()
    runs = [read_run(path) for path in sorted(PLACE.glob("fedbatch_simulated_*.csv"))]
    fit = identify_batches(runs[:4], held=runs[4:])
    print(fit.headline, fit.message, fit.tables()[0], f"{time.process_time() - began:.0f} s",
          sep="\n")  # fmt: skip
    against_truth(fit, made["rates"])
    ranked = rank_inputs(fit)
    print(*ranked, sep="\n")
    hours = 0.5 * np.arange(81)
    pulsed = np.resize(runs[3].inputs["feed"], 81)
    steady = np.clip(0.015 * np.exp(0.09 * hours), 0.0, 0.2)
    for name, feed in (("pulsed", pulsed), ("steady", steady)):
        found = predict(fit, hours, REST | {"feed": feed}, START).length(TITRE)
        true = made["plant"](START, feed, np.ones(81))
        print(f"{name}: {TITRE} g/L after {found}, plant {np.interp(TITRE, true[:, 3], hours):.2f}")
    plan = best_feed(
        fit, START, REST, product=PRODUCT, feed=(0.0, 0.3), volume=7.0, substrate=9.0,
        hours=(10.0, 45.0),
    )  # fmt: skip
    course = plan.course
    true = made["plant"](START, course.feed, np.ones(len(course.time)), apart=course.time[1])
    print(plan.headline, plan.tables()[0], sep="\n")
    print(f"plant: {true[-1, 2] * true[-1, 3]:.1f} g, substrate at most {true[:, 1].max():.2f} g/L")
    print(f"{time.process_time() - began:.0f} s")
    for name, result in (("batches", fit), ("plan", plan)) if sys.argv[1:] else ():
        beamfit.write_report(Path(sys.argv[1]) / f"{name}.html", result)
    if sys.argv[1:]:
        figure = Figure(figsize=(6, 4), layout="constrained")
        axes, order = figure.subplots(), ranked[::-1]
        axes.barh([each.name for each in order], [each.correlation for each in order])
        axes.set_xlabel("nonlinear correlation, sqrt(1 - exp(-2 I))")
        figure.savefig(Path(sys.argv[1]) / "ranking.png", dpi=150)


if __name__ == "__main__":
    main()
