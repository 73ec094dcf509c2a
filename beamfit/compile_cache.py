"""Compiled code kept from one process to the next: compiling is most of a first answer's time.

Every package that computes with JAX calls `prepare_jax` when it is imported. This module itself
imports no JAX.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path

# JAX's own names; in the environment they have capitals. Everything is kept: a command compiles
# hundreds of small functions in milliseconds each.
FOLDER = "jax_compilation_cache_dir"
KEEP = {
    # name: (JAX's default, ours)
    "jax_persistent_cache_min_compile_time_secs": (1.0, 0.0),
    "jax_persistent_cache_min_entry_size_bytes": (0, -1),
    # Small programs whose results are waited for: handing them to a thread takes a tenth of a fit.
    "jax_cpu_enable_async_dispatch": (True, False),
}

# XLA's older way to emit fused loops compiles in half the time, and what it makes is as quick but
# for thousands of searches in one call, 15 % slower (docs/design.md). XLA ends a process that names
# a flag it does not know: only where it was tried.
QUICK, TRIED = "xla_cpu_use_fusion_emitters", "0.10."

# For `jax.jit` of a program that runs a few times on small arrays, where it is no slower: it is
# compiled in half the time. No other compiled function can call such a one.
SELDOM = {"xla_backend_optimization_level": 0}

# For a loop over thousands of readings: optimised, whatever XLA_FLAGS say of all other programs.
LONG = {"xla_backend_optimization_level": 3}


def prepare_jax() -> None:
    """Import JAX with 64 bits, a compile cache, quick compilation and calls that wait.

    All of it by JAX's public settings, for the whole process. The cache is
    ``$XDG_CACHE_HOME/beamfit/jax`` (or ``~/.cache/…``); where nobody can write there, or others
    can, code is compiled anew. So is what is damaged, with JAX's warning until the folder is
    emptied. What the user has set, in the environment or in ``jax.config``, stands, but for
    64 bits. Calling it again does nothing.

    Examples
    --------
    >>> prepare_jax()
    >>> import jax
    >>> jax.config.jax_enable_x64
    True
    """
    import jax

    flags = os.environ.get("XLA_FLAGS", "")
    if jax.__version__.startswith(TRIED) and QUICK not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{QUICK}=false".strip()
    # Emittances are differences of products of order 1e-8: single precision has no digits left.
    jax.config.update("jax_enable_x64", True)
    for name, (usual, ours) in KEEP.items():
        if name.upper() not in os.environ and jax.config.values[name] == usual:
            jax.config.update(name, ours)
    if FOLDER.upper() not in os.environ and jax.config.jax_compilation_cache_dir is None:
        place = own_folder()
        code = None if place is None else Path(place, "jax")
        if code is not None:  # apart from locks of magnets, so that it can be emptied
            code.mkdir(mode=0o700, exist_ok=True)
        jax.config.update(FOLDER, None if code is None else str(code))


def own_folder() -> str | None:
    """Cache folder of this user alone, or None; code compiled into it is executed.

    Examples
    --------
    >>> own_folder() is None or own_folder().endswith("/beamfit")
    True
    """
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "beamfit"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        about = folder.stat()
    except (OSError, RuntimeError):  # no place to write, or no home at all
        return None
    if about.st_uid != os.getuid() or about.st_mode & 0o022:
        said = f"{folder} belongs to others or can be written to by them, and is not used"
        warnings.warn(f"{said}; chmod 700 and empty it", stacklevel=4)
        return None
    return str(folder) if os.access(folder, os.W_OK) else None
