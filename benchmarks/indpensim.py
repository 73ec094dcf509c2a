"""SIMULATED batches of penicillin: the equations that IndPenSim publishes, integrated by SciPy.

S. Goldrick et al., J. Biotechnol. 193 (2015) 70: hyphae in regions (growing tips A0, extending A1,
degenerated A3, autolysed A4) with vacuoles by size after G. Paul & C. Thomas, Biotechnol. Bioeng.
51 (1996) 558; oxygen, phenylacetic acid (PAA), nitrogen, and their inhibitions; G. Birol et al.,
Comput. Chem. Eng. 26 (2002) 1553, is its root. Temperature and pH are held (25 °C, 6.5), as the
controllers of the original hold them; recipes of the flows differ from batch to batch, and growth
and production differ and wander. Written apart from beamfit.

    python benchmarks/indpensim.py FOLDER [batches]

writes batch_01.csv, … (9), identifies all but the last four, and holds these back: rms of each
output against its readings, and how many of them the 95 % bands hold.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

APART = 1.0  # h from row to row
S, DO, P, V, A0, A1, A3, A4 = range(8)
N0, NM, PHI0, AGE, PAA, NIT, VISC = 8, 18, 19, 20, 21, 22, 23
# Radii of the vacuoles (cm), their growth (cm/h), spread, and densities (g/cm3).
R0, DELTA0, DELTA, GROW, SPREAD = 1.5e-4, 1e-4, 0.75e-4, 3.22e-5, 2.66e-11
RHO, RHO_WORN = 0.35, 0.18
SUGAR, OIL, PAA_FED, N_FED = 600.0, 1000.0, 530e3, 150e3  # g/L, g/L, mg/L, mg/L
KELVIN, PH = 298.0, 6.5
# Recipes: value until so many hours.
RECIPES = {
    "sugar": (
        [3, 12, 16, 20, 24, 28, 32, 36, 40, 44, 48, 52, 56, 60, 64, 68, 72, 76, 80, 160, 350],
        [8, 15, 30, 75, 150, 30, 37, 43, 47, 51, 57, 61, 65, 72, 76, 80, 84, 90, 116, 90, 80],
    ),
    "oil": ([4, 16, 56, 60, 64, 68, 72, 76, 80, 350], [22, 30, 35, 34, 33, 32, 31, 30, 29, 23]),
    "air": ([8, 20, 40, 90, 200, 250, 350], [30, 42, 55, 60, 75, 65, 60]),
    "pressure": ([12.5, 25, 30, 40, 100, 150, 200, 350], [0.6, 0.7, 0.8, 0.9, 1.1, 1, 0.9, 0.9]),
    "discharge": ([100, 102, 130, 132, 150, 152, 170, 172, 190, 192, 210, 212, 230, 232, 350],
                  [0, 4000, 0, 4000, 0, 4000, 0, 4000, 0, 4000, 0, 4000, 0, 4000, 0]),
    "water": ([50, 75, 150, 160, 170, 200, 250, 270, 350], [0, 500, 100, 0, 400, 150, 250, 0, 100]),
    "acid": ([5, 40, 200, 300, 350], [5, 0, 10, 4, 0]),
}  # fmt: skip


def gate(x):
    """A smooth step."""
    return 0.5 * (1.0 + np.tanh(x))


def slopes(_, x, u, mu_x, mu_p, alpha):
    """Rates of change of all states, per hour; `u` the flows by name."""
    s, a0, a1, a3 = x[S], x[A0], x[A1], x[A3]
    cells = x[A0 : A4 + 1].sum()
    thinned = (u["sugar"] + u["water"] + u["acid"] - evaporated(x[V])) / x[V]
    dense = 1100.0 + x[P] + cells
    # Oxygen at saturation under the mean pressure of the column of broth.
    height = 0.9 * x[V] / 1000.0 / (np.pi * 2.1**2)
    top = 1.0 + u["pressure"]
    bottom = top + dense * height * 9.81e-5
    full = (bottom - top) / np.log(bottom / top) * 0.21 / 0.0251
    acidity = 10.0**-PH
    warm = 450.0 * np.exp(-14880.0 / 8.314 / KELVIN) - 2.5e29 * np.exp(-173250.0 / 8.314 / KELVIN)
    held = warm / (1.0 + acidity / 1e-5 + 2.5e-8 / acidity) * gate(x[NIT] - 150.0)
    held *= gate(x[DO] - 0.1 * full) * gate(2400.0 - x[PAA])
    lysis = np.exp(-64.29 - 1.825 * PH + 0.3649 * KELVIN + 0.1280 * PH**2 - 4.9496e-4 * KELVIN**2)
    made_p = gate(x[DO] - 0.3 * full) * gate(x[PAA] - 200.0)
    made_p *= np.exp(-0.5 * ((s - 0.002) / 0.0015) ** 2) * 2.5 / np.sqrt(2.0 * np.pi)
    older = max(0.75 - 0.006 * x[AGE] / cells, 0.09)
    branch = 0.4 * mu_x * held * a1 * s / (0.05 + s)
    extend = mu_x * held * a0 * s / (0.009 + s)
    age = 5.36e-3 * a0 / (older + s)
    n = x[N0:NM]
    holes = x[PHI0] + np.sum(4.0 / 3.0 * np.pi * (R0 + DELTA * np.arange(9)) ** 3 * n[1:]) * DELTA
    inside = a1 / (2.0 * a1 / (a1 / RHO + holes)) - holes
    product = mu_p * RHO * inside * made_p
    opened = 1.71e-4 * inside / (0.05 + s)
    largest, beyond = R0 + 8 * DELTA, R0 + 10 * DELTA
    wear = np.pi * (largest + beyond) ** 3 / 6.0 * RHO_WORN * GROW * n[9]
    d = np.zeros_like(x)
    d[A0] = branch - age - a0 * thinned
    d[A1] = extend - branch + age - wear - a1 * thinned
    d[A3] = wear - 3.5e-3 * a3 - a3 * thinned
    d[A4] = 3.5e-3 * a3 - x[A4] * thinned
    d[P] = product - lysis * x[P] - x[P] * thinned
    fed = u["sugar"] * SUGAR + u["oil"] * OIL
    kept = 0.029 * a0 / (older + s) + 0.029 * RHO * inside * s / (0.05 + s)
    d[S] = fed / x[V] - 1.85 * (branch + extend) - kept - 0.9 * product - s * thinned
    d[V] = thinned * x[V] - u["discharge"] / (dense / 1000.0)
    grown = d[A0 : A4 + 1].sum()
    blow = u["air"] / 60.0 / (np.pi * 2.1**2)
    speed, wide = 100.0 / 60.0, 1.7
    idle = 15.0 * dense * speed**3 * wide**5
    gassed = 0.706 * (idle**2 * speed * wide**3 / (u["air"] / 60.0) ** 0.56) ** 0.45 / 1000.0
    m3 = x[V] / 1000.0
    blown = blow * 8.314 * KELVIN * m3 / (22.4 * height)
    blown *= np.log(1.0 + dense * 9.81 * height / (top * 1e5))
    thick = x[VISC] / 100.0 if x[VISC] > 4.0 else 0.01
    kla = alpha * blow**0.38 * ((gassed + blown) / m3) ** 0.34 * thick**-0.38
    kla *= 1.0 - (u["oil"] / x[V]) ** 0.25
    d[DO] = kla * (full - x[DO]) - 650.0 * grown - 17.5 * cells - 160.0 * d[P] - x[DO] * thinned
    d[N0] = opened * 6.0 / np.pi * (R0 + DELTA0) ** -3 - GROW * n[0]
    bent = (n[2:] - 2.0 * n[1:-1] + n[:-2]) / DELTA**2
    d[N0 + 1 : NM - 1] = -GROW * (n[2:] - n[:-2]) / (2.0 * DELTA) + SPREAD * bent
    last = x[NM]
    d[NM - 1] = (-GROW * (last - n[8]) / (2.0 * DELTA)
                 + SPREAD * (last - 2.0 * n[9] + n[8]) / DELTA**2)  # fmt: skip
    d[NM] = GROW * d[NM - 1] / (beyond - largest) - 3.5e-3 * last
    d[PHI0] = opened - GROW * n[0] * np.pi * (R0 + DELTA0) ** 3 / 6.0
    d[AGE] = cells
    d[PAA] = (u["acid"] * PAA_FED / x[V] - 187.5 * d[P] - 45.0 * grown - 1.05 * x[P]
              - x[PAA] * thinned)  # fmt: skip
    d[NIT] = (u["acid"] * N_FED + u["oil"] * 20e3 + u["shots"] * 400e3) / x[V]
    d[NIT] -= 10.0 * (branch + extend + age + 3.5e-3 * a3) + 80.0 * d[P] + 0.03 * cells
    d[NIT] -= x[NIT] * thinned
    d[VISC] = 3.0 * np.cbrt(max(a0, 0.0)) * 0.5 * 0.5 - 0.005 * u["water"]
    return d


def recipe(name, t, random):
    """Flow of a name at times: the recipe, its levels and switching times a little different."""
    until, values = (np.array(v, float) for v in RECIPES[name])
    if name not in ("discharge", "pressure"):
        values = values * (1.0 + 0.15 * random.normal(size=len(values)))
    return np.clip(values[np.minimum(np.searchsorted(until, t, side="right"), len(values) - 1)], 0,
                   None)  # fmt: skip


def wandering(random, n, size, hours=40.0):
    """A number that wanders about 0."""
    kept, found = np.exp(-APART / hours), np.zeros(n)
    found[0] = size * random.normal()
    for k in range(1, n):
        found[k] = kept * found[k - 1] + size * np.sqrt(1 - kept**2) * random.normal()
    return found


def batch(random, hours=230.0):
    """Times (h), flows and states (rows, 24) of one batch."""
    t = APART * np.arange(int(hours / APART) + 1)
    flows = {name: recipe(name, t, random) for name in RECIPES}
    mu_x = 0.41 * (1.0 + 0.03 * random.normal()) * (1.0 + wandering(random, len(t), 0.02))
    mu_p = 0.041 * (1.0 + 0.03 * random.normal()) * (1.0 + wandering(random, len(t), 0.02))
    alpha = 85.0 * (1.0 + 0.05 * random.normal())
    x = np.zeros(24)
    cells = 0.5 + 0.05 * random.normal()
    x[[S, DO, V, A0, A1]] = 1.0 + 0.1 * random.normal(), 15.0, 58e3, cells / 3, 2 * cells / 3
    x[V] += 500.0 * random.normal()
    x[[PAA, NIT, VISC]] = 1400.0 + 50.0 * random.normal(), 1700.0 + 50.0 * random.normal(), 4.0
    x[N0:PHI0] = 1e-6
    found, shots = [x], np.zeros(len(t))
    flows["shots"] = shots
    for k in range(len(t) - 1):
        # As the controllers do: acid where PAA is short, nitrogen by the shot.
        if t[k] > 40.0:
            flows["acid"][k] = np.clip(0.05 * (1100.0 - x[PAA]), 0.0, 15.0)
        shots[k] = 5.0 if x[NIT] < 400.0 else 0.0
        u = {name: float(v[k]) for name, v in flows.items()}
        end = solve_ivp(slopes, (0.0, APART), x, "LSODA", args=(u, mu_x[k], mu_p[k], alpha),
                        rtol=1e-5, atol=1e-7)  # fmt: skip
        x = np.maximum(end.y[:, -1], 0.0)
        found.append(x)
    return t, flows, np.array(found)


def evaporated(volume):
    """L/h at 25 °C."""
    return volume * 5.24e-4 * (np.exp(2.5 * (KELVIN - 273.0) / 100.0) - 1.0)


def record(random, t, flows, x):
    """Columns of a batch as a plant logs them, and the same without noise.

    Biomass is what lives (tips and body); what wears out and dies is lost to it. Liquid fed is less
    what evaporates. Biomass and titre are read every 12 h, the rest at every row.
    """
    liquid = flows["sugar"] + flows["water"] + flows["acid"] - evaporated(x[:, V])
    liquid = np.maximum(liquid, 1.0)  # at first more evaporates than is fed
    sugar = flows["sugar"] * SUGAR + flows["oil"] * OIL
    inputs = {
        "feed": liquid, "feed_substrate": sugar / liquid,
        "outflow": flows["discharge"] / (1.1 + 1e-3 * (x[:, P] + x[:, A0 : A4 + 1].sum(1))),
    }  # fmt: skip
    living = x[:, A0] + x[:, A1]
    true = {"biomass": living, "substrate": x[:, S], "volume": x[:, V], "titre": x[:, P]}
    grown = np.gradient(x[:, A0 : A4 + 1].sum(1), t)
    true["our"] = 0.65 * grown + 0.0175 * x[:, A0 : A4 + 1].sum(1) + 0.16 * np.gradient(x[:, P], t)
    true["cer"] = 0.1353 * living
    size = {"biomass": 0.03, "substrate": 0.05, "volume": 0.003, "titre": 0.03, "our": 0.03,
            "cer": 0.03}  # fmt: skip
    floor = {"biomass": 0.05, "substrate": 2e-5, "titre": 0.05}
    read = {}
    for name, values in true.items():
        noise = random.normal(size=(2, len(t)))
        y = values * (1.0 + size[name] * noise[0]) + floor.get(name, 0.0) * noise[1]
        if name in ("biomass", "titre"):
            y[np.arange(len(t)) % round(12.0 / APART) > 0] = np.nan
        read[name] = np.maximum(y, 0.0)
    return inputs, read, true


def write(place: Path, batches: int) -> None:
    """Write the files."""
    place.mkdir(exist_ok=True)
    for number in range(1, 1 + batches):
        random = np.random.default_rng([2015, number])
        t, flows, x = batch(random)
        inputs, read, true = record(random, t, flows, x)
        columns = {"time_h": t} | {f"u_{k}": v for k, v in inputs.items()}
        columns |= {f"y_{k}": v for k, v in read.items()}
        columns |= {f"note_{k}": v for k, v in true.items()}
        lines = ["# SIMULATED: IndPenSim's published equations, benchmarks/indpensim.py"]
        lines.append(",".join(columns))
        for row in zip(*columns.values(), strict=True):
            lines.append(",".join("" if np.isnan(v) else f"{v:.6g}" for v in row))
        (place / f"batch_{number:02d}.csv").write_text("\n".join(lines) + "\n")


# What the rates and the formation of product hang on: what is read on line stands for the age of
# the hyphae, which no balance of biomass knows.
POINTS, PRODUCT = ("substrate", "our", "biomass"), ("mu_b", "measured substrate", "biomass")


def study(place: Path) -> None:
    """Identify all batches but four, and predict these."""
    from beamfit.dynamics.fedbatch import identify_batches
    from beamfit.io.run import read_run

    began = time.process_time()
    runs = [read_run(path) for path in sorted(place.glob("batch_*.csv"))]
    fit = identify_batches(runs[:-4], held=runs[-4:], points=POINTS, product=PRODUCT)
    print(fit, f"{time.process_time() - began:.0f} s of processor", sep="\n")
    for name in fit.noise:
        rms = np.array([held.rms[name] for held in fit.held.values()])
        inside = np.mean([held.inside[name] for held in fit.held.values()])
        print(f"{name}: rms {np.sqrt(np.mean(rms**2)):.3g}, of the worst batch {rms.max():.3g}; "
              f"{100 * inside:.0f} % in the 95 % bands")  # fmt: skip


def main() -> None:
    """Write, identify, and say how well."""
    place = Path(sys.argv[1])
    write(place, int(sys.argv[2]) if len(sys.argv) > 2 else 9)
    study(place)


if __name__ == "__main__":
    main()
