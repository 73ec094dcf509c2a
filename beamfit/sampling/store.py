"""Posteriors on disk, in the layout of emcee's HDF5 backend."""

from __future__ import annotations

import hashlib
import io
import json
import os
import platform
import re
import time
from collections.abc import Mapping
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.writing import write_atomically

if TYPE_CHECKING:
    import h5py

    from beamfit.sampling.target import SamplingTarget

# Kind of file, and version, which changes with the contents of a store or the digest of a problem.
KIND, FORMAT = "beamfit-posterior", "3"
# Bytes of the HDF5 user block, which holds the file's digest; the smallest size that HDF5 allows.
SEAL_BYTES = 512
# Number of steps whose log density is recomputed to test that the model is the same.
CHECKED_STEPS = 8
# Relative tolerance on these log densities: compilers of different versions round differently.
DENSITY_TOLERANCE = 1e-6
PACKAGES = ("emcee", "h5py", "jax", "numpy", "scipy")
REMEDY = "; name another file, or move this one away"


class Provenance(NamedTuple):
    """Origin of a posterior.

    Attributes
    ----------
    command : str
        Command that made it.
    inputs : mapping of str to str
        Input files and their SHA-256.
    """

    command: str = "from Python"
    inputs: Mapping[str, str | None] = {}


FROM_PYTHON = Provenance()


class Checkpoint(NamedTuple):
    """State of a run, sufficient to continue as if it had not been interrupted.

    Attributes
    ----------
    chain, log_prob : array, shape (steps, walkers, n) and (steps, walkers)
        All steps, the warm-up included.
    random_state : tuple
        State of NumPy's Mersenne twister after the last step.
    share : float
        Share of long moves.
    began : int
        Step at which the present proposal, which depends on the chain before, came into use.
    producing : bool
        True if the warm-up is over, so that the chain from `began` on counts.
    seed : int
        Seed of the chain.
    """

    chain: np.ndarray
    log_prob: np.ndarray
    random_state: tuple
    share: float
    began: int
    producing: bool
    seed: int

    @property
    def counting(self) -> np.ndarray:
        """The chain after the warm-up."""
        return self.chain[self.began if self.producing else len(self.chain) :]

    @property
    def acceptance(self) -> float:
        """Share of accepted proposals after the warm-up; of all proposals during it."""
        first = max(self.began - 1, 0) if len(self.counting) else 0
        return float(np.mean(_accepted(self.chain[first:])))


def _accepted(chain: np.ndarray) -> np.ndarray:
    """True for each walker and step in which it moved, shape (steps - 1, walkers)."""
    return np.any(np.diff(chain, axis=0) != 0, axis=2)


def _contents(
    target: SamplingTarget,
    state: Checkpoint,
    provenance: Provenance,
    summary: Mapping[str, Any] | None,
) -> dict[str, tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """Collect the attributes and arrays of each group of a store."""
    from beamfit import __version__

    _, walkers, n = state.chain.shape
    random = {f"random_state_{i}": part for i, part in enumerate(state.random_state)}
    emcee = {  # the layout of emcee.backends.HDFBackend
        "version": version("emcee"),
        "nwalkers": walkers,
        "ndim": n,
        "has_blobs": False,
        "iteration": len(state.chain),
    }
    own = {"names": list(target.names), "units": list(target.units), "share": state.share}
    own |= {"began": state.began, "producing": state.producing}
    accepted = _accepted(state.chain).sum(axis=0)
    chain = {"accepted": accepted, "chain": state.chain, "log_prob": state.log_prob}
    fit = {"status": target.verdict.status.value, "message": target.verdict.message}
    places = {name: getattr(target, name) for name in ("mode", "covariance", "lower", "upper")}
    versions = {name: version(name) for name in PACKAGES}
    versions |= {"python": platform.python_version(), "beamfit": __version__}
    source = {
        "versions": json.dumps(versions),
        "seed": str(state.seed),
        "inputs": json.dumps(dict(provenance.inputs)),
        "command": provenance.command,
    }
    done = {"finished": json.dumps(summary is not None), "summary": json.dumps(summary or {})}
    return {
        "mcmc": (random | emcee | own, chain),
        "observed": ({}, {name: _storable(values) for name, values in target.observed.items()}),
        "fit": (fit | {"names": list(target.names)}, places),
        "posterior": (done, {}),
        "provenance": (source, {}),
    }


def _storable(values: Any) -> np.ndarray:
    values = np.asarray(values)
    return values.astype(object) if values.dtype.kind in "UO" else values


def save(
    path: str | PathLike[str],
    target: SamplingTarget,
    state: Checkpoint,
    provenance: Provenance,
    summary: Mapping[str, Any] | None = None,
) -> float:
    """Write a checkpoint; at any moment the file is the old one or the complete new one.

    Parameters
    ----------
    path : str or path
        File to write.
    target : SamplingTarget
        The posterior that is sampled.
    state : Checkpoint
        State of the run.
    provenance : Provenance
        Origin of the posterior.
    summary : mapping, optional
        Result in JSON types, once the chain is finished.

    Returns
    -------
    float
        Time taken, s.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    import h5py

    began = time.perf_counter()
    # The file is made in memory: on a full disk the HDF5 library crashes the process.
    with h5py.File("store", "w", driver="core", backing_store=False) as file:
        file.attrs["format"], file.attrs["problem"] = f"{KIND}-{FORMAT}", target.digest
        for name, parts in _contents(target, state, provenance, summary).items():
            group = file.create_group(name)
            group.attrs.update(parts[0])
            for key, values in parts[1].items():
                group.create_dataset(key, data=values)
        file.flush()
        content = add_seal(file.id.get_file_image())
    write_atomically(path, content, f".{Path(path).name}.partial")
    return time.perf_counter() - began


def add_seal(content: bytes) -> bytes:
    """Put an HDF5 file's digest in front of it, so that damage is detected before it is opened.

    The digest is in the HDF5 user block, which readers of the file ignore.
    """
    seal = f"{KIND}-{FORMAT} sha256 {hashlib.sha256(content).hexdigest()}\n"
    return seal.encode().ljust(SEAL_BYTES, b"\0") + content


def _remove_seal(content: bytes, path: str | PathLike[str]) -> bytes:
    """Return the HDF5 file after its digest, if the digest is right."""
    body, header = content[SEAL_BYTES:], re.match(rf"{KIND}-(\d{{1,9}}) ".encode(), content)
    if content.startswith(b"\x89HDF"):
        found = "an HDF5 file that beamfit did not write, or an earlier version did"
    elif header and header[1].decode() != FORMAT:
        found = f"a posterior store of format {header[1].decode()}, of another version of beamfit"
    elif content != add_seal(body):
        found = "a file that is no store, is damaged, or was changed since"
    else:
        return body
    raise InputError(found, f"a posterior store ({KIND}-{FORMAT}){REMEDY}", path=path)


def load(
    path: str | PathLike[str], target: SamplingTarget, seed: int, walkers: int
) -> Checkpoint | None:
    """Read a checkpoint of the same problem; the file is not changed.

    Parameters
    ----------
    path : str or path
        The store.
    target : SamplingTarget
        The posterior to sample.
    seed, walkers : int
        Seed and number of walkers of the run to continue.

    Returns
    -------
    Checkpoint or None
        None if there is no such file yet.

    Raises
    ------
    InputError
        If the file is damaged, not a store of beamfit, or of another problem, seed or number of
        walkers.
    """
    if not os.path.exists(path):
        return None
    import h5py

    try:
        content = Path(path).read_bytes()
    except OSError:
        found = "a store that cannot be read"
        raise InputError(found, f"a posterior store{REMEDY}", path=path) from None
    # A file with the right digest was written completely in this format.
    with h5py.File(io.BytesIO(_remove_seal(content, path)), "r") as file:
        state = _checkpoint(file)
        names = tuple(str(name) for name in file["mcmc"].attrs["names"])
        digest = file.attrs["problem"]
    difference = _difference(state, names, digest, target, seed, walkers)
    if difference is not None:
        raise InputError(difference[0], f"{difference[1]}{REMEDY}", path=path)
    return state


def _difference(
    state: Checkpoint,
    names: tuple[str, ...],
    digest: str,
    target: SamplingTarget,
    seed: int,
    walkers: int,
) -> tuple[str, str] | None:
    """Describe a store's difference from the run to continue, and what is expected, or None."""
    if names != target.names:
        found = f"the posterior of other numbers, {', '.join(names)}"
        return found, f"one of {', '.join(target.names)}"
    if digest != target.digest:
        found = "the posterior of another problem (other data, bounds, priors or likelihood)"
        return found, "one of the present problem"
    if state.seed != seed:
        return f"a chain begun with seed {state.seed}", f"seed {seed}"
    if state.chain.shape[1] != walkers:
        return f"a chain of {state.chain.shape[1]} walkers", f"{walkers}"
    # The digest does not contain the model's functions: compare their values at the walkers.
    for step in range(len(state.chain) - 1, -1, -max(1, len(state.chain) // CHECKED_STEPS)):
        now = target.log_probability(state.chain[step])
        if not np.allclose(
            now, state.log_prob[step], rtol=DENSITY_TOLERANCE, atol=1e3 * DENSITY_TOLERANCE
        ):
            return "the posterior of another model (other density)", "one of the present problem"
    return None


def _checkpoint(file: h5py.File) -> Checkpoint:
    """Read a checkpoint from an open store."""
    group = file["mcmc"]
    kind, keys, *rest = (group.attrs[f"random_state_{i}"] for i in range(5))
    return Checkpoint(
        chain=group["chain"][:],
        log_prob=group["log_prob"][:],
        random_state=(str(kind), keys, int(rest[0]), int(rest[1]), float(rest[2])),
        share=float(group.attrs["share"]),
        began=int(group.attrs["began"]),
        producing=bool(group.attrs["producing"]),
        seed=int(file["provenance"].attrs["seed"]),
    )


def finished(path: str | PathLike[str]) -> bool:
    """True if a store holds a finished chain with its summary."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return file["posterior"].attrs["finished"] == "true"
    except (OSError, KeyError):
        return False
