"""Settings of JAX and of BLAS, and a cache of compiled code, since compiling dominates the first
answer's time.

Every package that uses JAX calls `prepare_jax` on import. This module itself does not import JAX.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock

# Option names of JAX; the environment variables have capitals. All code is cached, because a
# command compiles hundreds of small functions in milliseconds each.
CACHE_FOLDER = "jax_compilation_cache_dir"
SETTINGS = {
    # name: (default of JAX, setting of beamfit)
    "jax_persistent_cache_min_compile_time_secs": (1.0, 0.0),
    "jax_persistent_cache_min_entry_size_bytes": (0, -1),
    # Synchronous calls: handing small programs to a thread takes a tenth of the time of a fit.
    "jax_cpu_enable_async_dispatch": (True, False),
}

# XLA's older emitter of fused loops compiles in half the time. Its code is equally fast, except 15
# % slower for thousands of searches in one call (docs/design.md). XLA aborts on an unknown flag, so
# the flag is set only for the versions of JAX with which it was tested.
FUSION_FLAG = "xla_cpu_use_fusion_emitters"
TESTED_JAX = "0.10."

# Compiler options of `jax.jit` for a program that runs a few times on small arrays: compiled in
# half the time, and not slower there. No other compiled function can call such a program.
SELDOM = {"xla_backend_optimization_level": 0}

# Compiler options for a loop over thousands of readings: optimised, whatever XLA_FLAGS say.
OPTIMISED = {"xla_backend_optimization_level": 3}


def prepare_jax() -> None:
    """Import JAX with 64 bits, a compile cache, fast compilation and synchronous calls.

    Uses public settings of JAX, for the whole process. The cache is ``$XDG_CACHE_HOME/beamfit/jax``
    (or ``~/.cache/…``). Without a writable folder, or if others can write to it, code is compiled
    each time. Damaged code is recompiled, with a warning of JAX until the folder is emptied.
    Settings of the user, in the environment or in ``jax.config``, take precedence, except for 64
    bits. Further calls do nothing.

    Examples
    --------
    >>> prepare_jax()
    >>> import jax
    >>> jax.config.jax_enable_x64
    True
    """
    import jax

    flags = os.environ.get("XLA_FLAGS", "")
    if jax.__version__.startswith(TESTED_JAX) and FUSION_FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{FUSION_FLAG}=false".strip()
    # Emittances are differences of products of order 1e-8: single precision loses all digits.
    jax.config.update("jax_enable_x64", True)
    for name, (default, ours) in SETTINGS.items():
        if name.upper() not in os.environ and jax.config.values[name] == default:
            jax.config.update(name, ours)
    if CACHE_FOLDER.upper() not in os.environ and jax.config.jax_compilation_cache_dir is None:
        place = own_folder()
        code = None if place is None else Path(place, "jax")
        if code is not None:  # a subfolder that can be emptied without the locks of magnets
            code.mkdir(mode=0o700, exist_ok=True)
        jax.config.update(CACHE_FOLDER, None if code is None else str(code))


# Calls that compute now, in whatever thread, and the limit that the first of them set.
_LOCK, _RUNNING = Lock(), []


@contextmanager
def usual_arithmetic() -> Iterator[None]:
    """Compute in a `with` block with one BLAS thread and NumPy's default floating-point errors.

    Matrices of scans and records are small: with two threads on a busy machine fits take three to
    twenty times as long. Of calls at the same time the last to end gives the threads back.
    Probabilities underflow, which a caller may have made an error.

    Examples
    --------
    >>> from threadpoolctl import threadpool_info
    >>> with usual_arithmetic():
    ...     {library["num_threads"] for library in threadpool_info()}
    {1}
    """
    import numpy as np
    import scipy.linalg  # loads the libraries of both, which are then limited  # noqa: F401
    from threadpoolctl import threadpool_limits

    with _LOCK:
        _RUNNING.append(_RUNNING[0] if _RUNNING else threadpool_limits(1, user_api="blas"))
    try:
        with np.errstate(all="warn", under="ignore"):
            yield
    finally:
        with _LOCK:
            limit = _RUNNING.pop()
            if not _RUNNING:
                limit.restore_original_limits()


def own_folder() -> str | None:
    """Return the private cache folder of the user, or None; its content is executed as code.

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
