"""How a stored beam decays: the law, the loss mechanisms, and the fit of the law's parameters."""

import jax

jax.config.update("jax_enable_x64", True)
