"""Every result in every form: dict, frame, picture, print and quantities by their names."""

import math

import numpy as np
import pytest

import beamfit


@pytest.fixture(scope="module")
def results(root):
    fit = beamfit.fit_emittance(
        root / "measurements/lcls_otr2.csv", root / "lattices/lcls_otr2.toml"
    )
    beam = beamfit.Beam(np.array([q.value for q in fit.x.sigma]))
    wish = [beamfit.Target("size", "x", 2e-4)]
    study = beamfit.study(root / "measurements/aps_1999_decay.csv")
    (response,) = beamfit.identify(root / "measurements/valve_level_simulated.csv", delay=2)
    return {
        "emittance": fit,
        "plane": fit.x,
        "slices": beamfit.fit_slices(
            root / "measurements/gtf_slices_simulated.csv", root / "lattices/gtf.toml"
        ),
        "design": beamfit.design(fit, count=1),
        "setpoint": beamfit.find_setpoint(fit.line, {"x": beam}, {"Q525": (-6, 0)}, wish),
        "decay": study.answers[0].fit,
        "study": study,
        "trend": beamfit.trend([study]),
        "response": response,
        "problem": beamfit.solve(root / "formulations/appendix_d.bf"),
    }


NAMES = ["emittance", "plane", "slices", "design", "setpoint"]
NAMES += ["decay", "study", "trend", "response", "problem"]
# Results without a picture of their own: parts of one, or advice.
UNDRAWN = {"plane", "design", "setpoint", "problem"}


@pytest.mark.parametrize("name", NAMES)
def test_print_says_the_verdict_first(results, name):
    found = results[name]
    first = str(found).strip().splitlines()[0]
    assert first.startswith(found.headline[:20]) or name == "decay"
    assert "<" + type(found).__name__ in repr(found)


@pytest.mark.parametrize("name", NAMES)
def test_a_frame_has_a_row_a_quantity(results, name):
    pytest.importorskip("pandas")
    frame = results[name].to_frame()
    assert len(frame) > 0
    if "unit" in frame:
        listed = dict(zip(frame.index, frame["value"], strict=True))
        assert all(math.isfinite(v) for v in listed.values())


def test_quantities_by_their_names(results):
    fit, decay = results["emittance"], results["decay"]
    assert list(fit) == ["x", "y"]
    assert fit["x"]["emittance"] == fit.x.emittance
    assert {n: decay[n] for n in decay} == decay.quantities
    assert list(results["problem"]) == ["variables.I_2"]
    with pytest.raises(beamfit.InputError, match=r"no quantity 'lifetme_mean'; expected .*mean"):
        decay["lifetme_mean"]


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_shows_itself_in_a_notebook(results, name):
    if name in UNDRAWN:
        with pytest.raises(beamfit.InputError, match="no picture"):
            results[name].plot()
    else:
        assert results[name].plot()._repr_png_().startswith(b"\x89PNG")


def test_a_plane_of_the_picture_is_chosen(results):
    drawn = {p: results["emittance"].plot(plane=p)._repr_png_() for p in "xy"}
    assert drawn["x"] != drawn["y"]
