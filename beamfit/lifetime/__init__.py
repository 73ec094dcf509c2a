"""How a stored beam decays: the law, the loss mechanisms, and the fit of the law's parameters."""

from beamfit.compile_cache import prepare_jax

prepare_jax()
