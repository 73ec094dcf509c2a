"""The grey-box core: maps with sensitivities, networks with gains, constrained fits that explain.

It knows nothing about beams. The parts are imported from their modules:
`maps`, `mlp`, `bounds`, `equations`, `problem`, `solve`, `fit`.
"""

from beamfit.compile_cache import prepare_jax

prepare_jax()
