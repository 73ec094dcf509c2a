"""Size measurements until a gun is tuned, on SIMULATED guns of known minimum.

    python -m benchmarks.tuning --knobs 2 --seeds 10

Guns are those of `benchmarks.guns`. Of each gun a line: beam sizes (means of 10 shots) until the
setting called best stays within 5 % of the true minimum, sizes until the fit says to stop, how far
above the minimum its setting then is, and if the 95 % interval of the value holds the truth.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from benchmarks.guns import emittance_at, gun_of, minimum_of, tuned

WITHIN, FIRST = 0.05, 8


def run(knobs: int, seed: int, most: int) -> tuple[int, int, float, bool, float]:
    """Sizes until within 5 % for good, until the stop, excess and cover there, s of CPU a row."""
    gun = gun_of(knobs, seed)
    least, excess, begun = minimum_of(gun)[1], [], time.process_time()
    for fit in tuned(gun, seed, FIRST, most, WITHIN):
        excess.append(emittance_at(gun, fit.settings) / least - 1.0)
        if fit.done:
            break
    last = max((i for i, e in enumerate(excess) if e > WITHIN), default=-1)
    low, high = fit.minimum.interval_95
    each = (time.process_time() - begun) / len(excess)
    return FIRST + last + 1, FIRST + len(excess) - 1, excess[-1], low <= least <= high, each


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--knobs", type=int, choices=(2, 4, 6), default=2)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--most", type=int, default=80, help="most sizes of a gun")
    told = parser.parse_args()
    print("seed  within 5 %  stop  excess there  value held  CPU s a row")
    found = []
    for seed in range(told.seeds):
        found.append(run(told.knobs, seed, told.most))
        near, stop, excess, held, each = found[-1]
        print(f"{seed:4d}  {near:10d}  {stop:4d}  {100 * excess:10.1f} %  {held!s:>10}  {each:.2f}",
              flush=True)  # fmt: skip
    near, stop, excess, held, _ = map(np.array, zip(*found, strict=True))
    print(
        f"{told.knobs} knobs, {told.seeds} guns: median {np.median(near):g} sizes until within "
        f"5 %, {np.median(stop):g} until the stop; {np.mean(excess <= WITHIN):.0%} of stops within "
        f"5 %, {np.mean(held):.0%} of 95 % intervals of the value hold it"
    )


if __name__ == "__main__":
    main()
