"""Drawing from posteriors: targets, moves, convergence, stores. It knows nothing of beams."""

import jax

jax.config.update("jax_enable_x64", True)
