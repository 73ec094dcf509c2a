"""Write the small files of tests/golden/data: SIMULATED or invented, good, poor and hopeless."""

from pathlib import Path

import numpy as np

HERE = Path(__file__).parent / "data"
SOURCE = "# SIMULATED by tests/golden/make_data.py from measurements/gtf_simulated.csv: "


def gtf():
    """Currents, sizes and errors of the simulated scan."""
    lines = (Path(__file__).parents[2] / "measurements/gtf_simulated.csv").read_text().splitlines()
    return np.array([line.split(",") for line in lines if line[0].isdigit()], float)


def write(name, note, rows, header="Q2_A,size_x_um,size_x_error_um"):
    """Write one table."""
    body = [",".join(f"{v:.3f}" for v in row) for row in rows]
    (HERE / name).write_text("\n".join([SOURCE + note, header, *body]) + "\n")


def main():
    """Write them all."""
    rows = gtf()
    random = np.random.default_rng(4)
    noise = rows.copy()
    noise[:, 1] = 150.0 * np.exp(0.3 * random.normal(size=len(rows)))
    noise[:, 2] = 0.02 * noise[:, 1]
    write("noise.csv", "pure noise, no beam", noise)
    write("one_sided.csv", "five settings before the waist", rows[:5])
    write("three_points.csv", "three settings", rows[[2, 7, 12]])
    write("no_errors.csv", "without errors", rows[:, :2], "Q2_A,size_x_um")
    poor = rows.copy()
    poor[:, 2] /= 5.0
    write("poor.csv", "errors five times too small", poor)
    outlier = rows.copy()
    outlier[4, 1] *= 1.5
    write("outlier.csv", "the fifth size half as large again", outlier)
    write(
        "negative_size.csv", "a size with the wrong sign", [[0, 300, 6], [1, -200, 4], [2, 90, 2]]
    )
    short = "# invented: too short to tell a from b\ntime_s,beam_current_mA\n"
    time = np.arange(0, 600, 60)
    # Exact readings would leave the verdict to rounding.
    current = 100.0 * np.exp(-time / 360000) + 1e-4 * np.random.default_rng(5).normal(size=10)
    decay = [f"{t},{i:.6f}" for t, i in zip(time, current, strict=True)]
    (HERE / "short_decay.csv").write_text(short + "\n".join(decay) + "\n")


if __name__ == "__main__":
    main()
