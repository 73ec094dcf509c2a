"""How processes respond to their inputs: difference and differential equations in JAX."""

from beamfit.compile_cache import prepare_jax

prepare_jax()
