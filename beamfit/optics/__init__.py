"""Linear optics in JAX: focusing functions, elements, the beam line and the beam matrix."""

import jax

# Emittances are differences of products of order 1e-8: single precision has no digits left.
jax.config.update("jax_enable_x64", True)
