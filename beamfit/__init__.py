"""Beam emittance and lifetime from quadrupole scans and current records.

>>> import beamfit
>>> beam = beamfit.BeamMatrix.from_twiss(emittance=2.67e-9, beta=1.28, alpha=-0.08)
>>> f"{beam.normalized_emittance(135.0) * 1e6:.3f} um"
'0.705 um'
"""

from importlib import import_module

__version__ = "0.1.0"

# Public name -> module. Loaded on first use, so that `beamfit --help` and a bad file are
# answered before JAX has been imported.
_HOME = {
    "Anchor": "beamfit.emittance.assumptions",
    "BeamMatrix": "beamfit.optics.beam",
    "Beamline": "beamfit.optics.beamline",
    "DecayFit": "beamfit.lifetime.fit",
    "DecayRecord": "beamfit.lifetime.record",
    "Drift": "beamfit.optics.elements",
    "EmittanceFit": "beamfit.emittance.fit",
    "InputError": "beamfit.errors",
    "Noise": "beamfit.noise.model",
    "Posterior": "beamfit.sampling.posterior",
    "QuadScan": "beamfit.emittance.scan",
    "Quadrupole": "beamfit.optics.elements",
    "Screen": "beamfit.optics.elements",
    "SectorDipole": "beamfit.optics.elements",
    "ThinLens": "beamfit.optics.elements",
    "constant_a_test": "beamfit.lifetime.systematics",
    "find_setpoint": "beamfit.emittance.setpoint",
    "fit_decay": "beamfit.lifetime.fit",
    "fit_decays": "beamfit.lifetime.fit",
    "fit_emittance": "beamfit.emittance.fit",
    "fit_sizes": "beamfit.emittance.sigma",
    "load_fit": "beamfit.io.result",
    "load_lattice": "beamfit.io.line",
    "loss_coefficients": "beamfit.lifetime.mechanisms",
    "moving_lifetime": "beamfit.lifetime.systematics",
    "read_decay_record": "beamfit.io.decay_record",
    "read_noise": "beamfit.io.priors",
    "read_operation": "beamfit.io.ring",
    "read_quad_scan": "beamfit.io.scan",
    "read_ring": "beamfit.io.ring",
    "save_fit": "beamfit.io.result",
    "split_record": "beamfit.lifetime.pieces",
    "systematics": "beamfit.emittance.sensitivity",
    "write_report": "beamfit.report.page",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'beamfit' has no attribute '{name}'")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
