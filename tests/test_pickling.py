"""Results go to other processes and come back: pools of processes, joblib, dask."""

import multiprocessing
import pickle

import pytest

import beamfit

SCAN, LINE = "measurements/lcls_otr2.csv", "lattices/lcls_otr2.toml"
VALVE, RING = "measurements/valve_level_simulated.csv", "lattices/spear3_2003.toml"
SHIFT = "measurements/spear3_shift_simulated.csv"
KNOBS = {"SOL": (190.0, 210.0), "phase_deg": (-12.0, 12.0)}
GUN = "measurements/gun_tuning_simulated.csv", "lattices/gun_tuning.toml"
PROFILES = "measurements/profiles_simulated.csv"
RESULTS = {
    "known": lambda: beamfit.fit_emittance(SCAN, LINE),
    "calibration": lambda: beamfit.fit_emittance(SCAN, LINE, scenario="calibration"),
    "transport": lambda: beamfit.fit_emittance(SCAN, LINE, scenario="transport-network"),
    "focusing": lambda: beamfit.fit_emittance(SCAN, LINE, scenario="focusing-network"),
    "samples": lambda: beamfit.fit_emittance(SCAN, LINE).sample(seed=1),
    "density": lambda: beamfit.fit_density(PROFILES, LINE),
    "tuning": lambda: beamfit.fit_tuning(*GUN, KNOBS),
    "decay": lambda: beamfit.fit_decay("measurements/aps_1999_decay.csv"),
    "shift": lambda: beamfit.study_shift(beamfit.study(SHIFT, RING).decays, RING),
    "response": lambda: beamfit.identify(VALVE)[0],
    "states": lambda: beamfit.identify(VALVE, "state-space")[0],
    "document": lambda: beamfit.solve("formulations/appendix_d.bf"),
}


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_is_the_same_after_pickling(name):
    result = RESULTS[name]()
    again = pickle.loads(pickle.dumps(result))
    assert str(again) == str(result)
    assert again.to_dict() == result.to_dict()


def test_a_pool_of_processes_fits_scans():
    scan, line = beamfit.read_quad_scan(SCAN), beamfit.load_lattice(LINE)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        (fit,) = pool.starmap(beamfit.fit_emittance, [(scan, line)])
    assert fit.to_dict() == beamfit.fit_emittance(scan, line).to_dict()
    # One object of each scenario and response, by which the rest of the package compares.
    assert fit.statement is beamfit.fit_emittance(scan, line).statement
