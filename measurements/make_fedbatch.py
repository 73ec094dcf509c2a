"""Make measurements/fedbatch_simulated_1.csv to _5.csv: batches of a SIMULATED fermentation.

    python measurements/make_fedbatch.py

Biomass X grows on substrate S by Monod kinetics with inhibition by substrate (Haldane), held up
where air is short; product P forms with growth and less where much substrate is left. Integrated
by scipy's LSODA, apart from the package. The rates and their numbers are in `rates`.
"""

from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from beamfit.writing import write_atomically

FED = 200.0
APART = 0.5
COLUMNS = ("biomass", "substrate", "volume", "titre")


def rates(substrate, air):
    """Growth, consumption and product formation, 1/h."""
    s = np.maximum(substrate, 0.0)
    growth = 0.30 * s / (1.0 + s + s**2 / 20.0) * air / (0.25 + air)
    consumption = growth / 0.5 + 0.03 * s / (1.0 + s)
    product = (0.10 * growth + 0.004 * s / (1.0 + s)) / (1.0 + s / 8.0)
    return growth, consumption, product


def plant(begin, feed, air, apart=APART, fed=FED):
    """States X, S, V, P at the start of each step, shape (steps, 4); inputs hold in a step."""

    def slope(_, x, f, a):
        growth, consumption, product = rates(x[1], a)
        thinned = f / x[2]
        return [
            (growth - thinned) * x[0],
            thinned * (fed - x[1]) - consumption * x[0],
            f,
            product * x[0] - thinned * x[3],
        ]

    states = [np.asarray(begin, float)]
    for f, a in zip(feed[:-1], air[:-1], strict=True):
        end = solve_ivp(slope, (0.0, apart), states[-1], "LSODA", args=(f, a), rtol=1e-8, atol=1e-9)
        states.append(end.y[:, -1])
    return np.array(states)


def recipes(random):
    """Five ways to run it: begin, feed in L/h, air; none as steady as it could be."""
    for hours, x0, s0, shape in (
        (40, 0.8, 8.0, lambda t: 0.012 * np.exp(0.075 * t)),
        (34, 1.2, 14.0, lambda t: 0.05 * (t > 6) + 0.05 * (t > 18)),
        (44, 0.8, 5.0, lambda t: 0.01 + 0.0035 * t),
        (38, 1.0, 10.0, lambda t: 0.30 * ((t % 6) < 2) * (t > 9)),
        (36, 1.5, 3.0, lambda t: 0.04 + 0.06 * (t > 12) + 0.06 * (t > 24)),
    ):
        t = APART * np.arange(2 * hours + 1)
        wild = 1.0 + 0.3 * np.repeat(random.normal(size=len(t) // 4 + 1), 4)[: len(t)]
        air = np.repeat(random.uniform(0.3, 1.2, len(t) // 10 + 1), 10)[: len(t)]
        yield t, (x0, s0, 4.0, 0.0), np.maximum(shape(t) * wild, 0.0).round(4), air.round(2)


def measured(random, air, states):
    """Columns with noise of 3 %, of volume 0.3 %: biomass, substrate hourly, titre two-hourly."""
    relative = {"biomass": 0.03, "substrate": 0.03, "volume": 0.003, "titre": 0.03}
    every = {"biomass": 2, "substrate": 2, "volume": 1, "titre": 4}
    floor = {"biomass": 0.02, "substrate": 0.05, "volume": 0.0, "titre": 0.005}
    found = {}
    for name, true in zip(COLUMNS, states.T, strict=True):
        noise = random.normal(size=(2, len(true)))
        values = true * (1 + relative[name] * noise[0]) + floor[name] * noise[1]
        values[np.arange(len(true)) % every[name] > 0] = np.nan
        found[name] = np.maximum(values, 0.0)
    growth, consumption, _ = rates(states[:, 1], air)
    evolved = (0.6 * growth + 0.4 * consumption) * states[:, 0]
    return found | {"offgas": evolved * (1 + 0.03 * random.normal(size=len(air)))}


def main() -> None:
    """Write the files."""
    random = np.random.default_rng(1)
    for number, (t, begin, feed, air) in enumerate(recipes(random), start=1):
        found = measured(random, air, plant(begin, feed, air))
        lines = [
            "# SIMULATED, not measured: Monod kinetics with inhibition by substrate, made by "
            "make_fedbatch.py",
            "# feed in L/h of 200 g/L substrate, air in vvm; concentrations in g/L, volume in L, "
            "offgas in g/(L h)",
            "time_h,u_feed,u_feed_substrate,u_air," + ",".join(f"y_{name}" for name in found),
        ]
        for k, time in enumerate(t):
            cells = ("" if np.isnan(v[k]) else f"{v[k]:.4g}" for v in found.values())
            lines.append(f"{time:g},{feed[k]:g},{FED:g},{air[k]:g}," + ",".join(cells))
        place = Path(__file__).with_name(f"fedbatch_simulated_{number}.csv")
        write_atomically(place, ("\n".join(lines) + "\n").encode())


if __name__ == "__main__":
    main()
