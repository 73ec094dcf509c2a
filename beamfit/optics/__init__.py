"""Linear optics in JAX: focusing functions, elements, the beam line and the beam matrix."""

from beamfit.compile_cache import prepare_jax

prepare_jax()
