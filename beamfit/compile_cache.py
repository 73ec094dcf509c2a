"""Compiled code kept from one process to the next: compiling is most of a first answer's time.

Every package that computes with JAX calls `prepare_jax` when it is imported. This module itself
imports no JAX.
"""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["prepare_jax"]

# JAX's own names; in the environment they have capitals. Everything is kept: a command compiles
# hundreds of small functions in milliseconds each.
FOLDER = "jax_compilation_cache_dir"
KEEP = {
    # name: (JAX's default, ours)
    "jax_persistent_cache_min_compile_time_secs": (1.0, 0.0),
    "jax_persistent_cache_min_entry_size_bytes": (0, -1),
}


def prepare_jax() -> None:
    """Import JAX with 64 bits and a compile cache.

    The cache is ``$XDG_CACHE_HOME/beamfit`` (or ``~/.cache/beamfit``); where nobody can write
    there, code is compiled anew. What the user has set, in the environment or in ``jax.config``,
    stands. Calling it again does nothing.

    Examples
    --------
    >>> prepare_jax()
    >>> import jax
    >>> jax.config.jax_enable_x64
    True
    """
    import jax

    # Emittances are differences of products of order 1e-8: single precision has no digits left.
    jax.config.update("jax_enable_x64", True)
    for name, (usual, ours) in KEEP.items():
        if name.upper() not in os.environ and getattr(jax.config, name) == usual:
            jax.config.update(name, ours)
    if FOLDER.upper() not in os.environ and jax.config.jax_compilation_cache_dir is None:
        jax.config.update(FOLDER, _place())


def _place() -> str | None:
    """The folder of the cache, or None where there can be none."""
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "beamfit"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no place to write, or no home at all
        return None
    return str(folder) if os.access(folder, os.W_OK) else None
