"""The noise of a laboratory is learned from its scans, and its file is read back."""

import numpy as np
import pytest

import beamfit
from beamfit.emittance.fit import noise_samples
from beamfit.emittance.scan import QuadScan
from beamfit.emittance.transport import rows_line
from beamfit.errors import InputError
from beamfit.io.priors import read_noise, write_noise
from beamfit.noise.learn import learn_noise
from beamfit.noise.model import Noise


def archive(scatter, count, seed=0):
    """SIMULATED scans of seven settings, five shots of 1 %; settings scatter beyond."""
    rng = np.random.default_rng(seed)
    r11, r12 = np.linspace(1.5, -1.5, 7), np.full(7, 2.0)
    true = np.sqrt(r11**2 * 1e-8 + r12**2 * 4e-10)
    for _ in range(count):
        level = true * (1 + scatter * np.exp(0.3 * rng.standard_normal()) * rng.standard_normal(7))
        shots = level[:, None] * (1 + 0.01 * rng.standard_normal((7, 5)))
        scan = QuadScan(
            {"Q": np.arange(7.0)},
            {"Q": "A"},
            {"x": shots.mean(1)},
            {"x": shots.std(1, ddof=1) / np.sqrt(5)},
            shots=np.full(7, 5),
            shot_size={"x": shots},
            energy=np.full(7, 100.0),
            transfer={"x": np.stack([r11, r12], -1)},
        )
        yield scan, rows_line(scan)


@pytest.mark.parametrize("scatter", [0.02, 0.06])
def test_the_scatter_of_settings_is_learned_with_its_error(scatter):
    samples = list(noise_samples(archive(scatter, 30), Noise()))
    learned = learn_noise(samples, Noise(), "a simulated archive")
    middle, error = learned.noise.scatter.middle, learned.errors["scatter"]
    stated = float(error.split("[")[1].split(",")[0])
    assert abs(middle - scatter) < 3 * stated < 0.6 * scatter
    assert learned.noise.unstated == Noise().unstated  # of which no plane tells anything
    assert learned.planes == {"shots": 30, "stated": 0, "none": 0}


def stated(factor, count, alike, seed=0):
    """SIMULATED scans whose stated errors are too small by a factor; of one share, or not."""
    rng = np.random.default_rng(seed)
    r11, r12 = np.linspace(1.5, -1.5, 8), np.full(8, 2.0)
    true = np.sqrt(r11**2 * 1e-8 + r12**2 * 4e-10)
    for _ in range(count):
        error = 0.02 * np.exp((0.0 if alike else 0.4) * rng.standard_normal(8))
        size = true * (1 + factor * error * rng.standard_normal(8))
        transfer = {"x": np.stack([r11, r12], -1)}
        sizes = {"x": size}, {"x": error * size}
        energy = np.full(8, 100.0)
        scan = QuadScan({"Q": np.arange(8.0)}, {"Q": "A"}, *sizes, energy=energy, transfer=transfer)
        yield scan, rows_line(scan)


@pytest.mark.parametrize("alike", [True, False], ids=["one share", "different"])
@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_stated_errors_are_learned_to_be_right_or_too_small(factor, alike):
    """Where all are right the factor may be near one: no narrow prior wins by its nodes."""
    learned = learn_noise(list(noise_samples(stated(factor, 25, alike), Noise())), Noise(), "own")
    right, middle = learned.noise.right, learned.noise.factor.middle
    assert right > 0.8 if factor == 1.0 else right < 0.2
    assert middle == pytest.approx(2.0, rel=0.25) or factor == 1.0
    assert "nan" not in learned.errors["factor"] + learned.errors["right"]


def test_a_few_scans_teach_nothing():
    with pytest.raises(InputError, match="3 of shots"):
        learn_noise(list(noise_samples(archive(0.03, 3), Noise())), Noise(), "three")


def test_the_file_is_read_back_and_makes_errors_alike(tmp_path):
    samples = list(noise_samples(archive(0.005, 12), Noise()))
    learned = learn_noise(samples, Noise(), "quiet screens")
    write_noise(file := tmp_path / "noise.toml", learned)
    own = read_noise(file)
    assert own.source == "quiet screens"
    assert own.scatter.middle == pytest.approx(learned.noise.scatter.middle, rel=1e-3)
    pairs = list(archive(0.005, 10, seed=9))
    usual = [beamfit.fit_emittance(scan, line).x.emittance.error for scan, line in pairs]
    quiet = [beamfit.fit_emittance(scan, line, noise=own).x.emittance.error for scan, line in pairs]
    # What is known of the screens is no longer guessed from the residuals of one scan.
    assert np.ptp(np.quantile(quiet, (0.2, 0.8))) < 0.5 * np.ptp(np.quantile(usual, (0.2, 0.8)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("scatter = [0.03]", "two numbers"),
        ("right = 2.0", "between 0 and 1"),
        ("rigth = 0.5", "did you mean right"),
        ("width = 0.5", "a width above 1"),
        ('format = "beamfit-ring-1"', "beamfit-noise-1"),
    ],
)
def test_what_is_wrong_in_a_file_has_its_line(tmp_path, text, words):
    file = tmp_path / "noise.toml"
    file.write_text(f"# our screens\n{text}\n")
    with pytest.raises(InputError, match=words) as error:
        read_noise(file)
    assert error.value.line == 2
