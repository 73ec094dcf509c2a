"""Beam emittance and lifetime from quadrupole scans and current records.

>>> import beamfit
>>> beam = beamfit.BeamMatrix.from_twiss(emittance=2.67e-9, beta=1.28, alpha=-0.08)
>>> f"{beam.normalized_emittance(135.0) * 1e6:.3f} um"
'0.705 um'
"""

from functools import cache
from pkgutil import resolve_name

__version__ = "0.1.0"

# Public name -> module, or module:name if the name differs there. Loaded on first use, so that
# `beamfit --help` and a bad file are answered before JAX is imported.
_HOME = {
    "Anchor": "beamfit.emittance.assumptions",
    "Beam": "beamfit.emittance.targets",
    "BeamMatrix": "beamfit.optics.beam",
    "Beamline": "beamfit.optics.beamline",
    "DecayFit": "beamfit.lifetime.fit",
    "DecayRecord": "beamfit.lifetime.record",
    "DensityFit": "beamfit.density.fit",
    "Drift": "beamfit.optics.elements",
    "EmittanceFit": "beamfit.emittance.fit",
    "EmittanceTable": "beamfit.tuning.knobs",
    "InputError": "beamfit.errors",
    "Job": "beamfit.batch.job",
    "Machine": "beamfit.lifetime.study",
    "Monitor": "beamfit.lifetime.record",
    "Noise": "beamfit.noise.model",
    "Posterior": "beamfit.sampling.posterior",
    "QuadScan": "beamfit.emittance.scan",
    "Quadrupole": "beamfit.optics.elements",
    "Quantity": "beamfit.quantity",
    "Run": "beamfit.dynamics.record",
    "Screen": "beamfit.optics.elements",
    "SectorDipole": "beamfit.optics.elements",
    "Status": "beamfit.errors",
    "Target": "beamfit.emittance.targets",
    "ThinLens": "beamfit.optics.elements",
    "TuningFit": "beamfit.tuning.fit",
    "check": "beamfit.io.check:file_summary",
    "constant_a_test": "beamfit.lifetime.systematics",
    "control": "beamfit.commands",
    "design": "beamfit.emittance.design:plan_measurements",
    "find_setpoint": "beamfit.emittance.setpoint",
    "fit_decay": "beamfit.lifetime.fit",
    "fit_decays": "beamfit.lifetime.fit",
    "fit_density": "beamfit.density.fit",
    "fit_emittance": "beamfit.emittance.fit",
    "fit_lifetimes": "beamfit.lifetime.lifetime_table",
    "fit_sizes": "beamfit.emittance.sigma",
    "fit_slices": "beamfit.emittance.slices",
    "fit_tuning": "beamfit.tuning.fit",
    "identify": "beamfit.commands",
    "load_fit": "beamfit.io.result",
    "load_lattice": "beamfit.io.line",
    "loss_coefficients": "beamfit.lifetime.mechanisms",
    "moving_lifetime": "beamfit.lifetime.systematics",
    "read_decay_record": "beamfit.io.decay_record",
    "read_formulation": "beamfit.io.formulation",
    "read_noise": "beamfit.io.priors",
    "read_operation": "beamfit.io.ring",
    "read_quad_scan": "beamfit.io.scan",
    "read_ring": "beamfit.io.ring",
    "read_run": "beamfit.io.run",
    "read_tuning_scan": "beamfit.io.scan",
    "run_batch": "beamfit.batch.run",
    "save_fit": "beamfit.io.result",
    "scan_machine": "beamfit.commands",
    "solve": "beamfit.commands",
    "split_record": "beamfit.lifetime.pieces",
    "study": "beamfit.lifetime.study:study_record",
    "study_shift": "beamfit.lifetime.ring_study",
    "systematics": "beamfit.emittance.systematics",
    "trend": "beamfit.lifetime.course:trend_of",
    "watch": "beamfit.commands",
    "write_report": "beamfit.report.page",
}
# Functions that accept paths in place of objects read from them.
_WITH_PATHS = {
    "constant_a_test",
    "control",
    "design",
    "find_setpoint",
    "fit_decay",
    "fit_decays",
    "fit_density",
    "fit_emittance",
    "fit_lifetimes",
    "fit_slices",
    "fit_tuning",
    "identify",
    "loss_coefficients",
    "moving_lifetime",
    "split_record",
    "study",
    "study_shift",
    "trend",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'beamfit' has no attribute '{name}'")
    return _resolve(name)


@cache  # one object per name, so that functions can be pickled
def _resolve(name: str) -> object:
    home = _HOME[name]
    found = resolve_name(home if ":" in home else f"{home}:{name}")
    if name not in _WITH_PATHS:
        return found
    return resolve_name("beamfit.commands:with_paths")(found, name)


def __dir__() -> list[str]:
    return sorted(__all__)
