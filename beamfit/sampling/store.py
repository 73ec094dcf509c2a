"""Posteriors on disk, in emcee's own layout: the one file of this package that opens files."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Mapping
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.sampling.moves import Proposal, Student, Widening
from beamfit.sampling.target import Target

if TYPE_CHECKING:
    import h5py

__all__ = ["Checkpoint", "Provenance", "finished", "load", "save"]

FORMAT = "beamfit-posterior-1"
PACKAGES = ("emcee", "h5py", "jax", "numpy", "scipy")
REMEDY = "; name another file, or move this one away"


class Provenance(NamedTuple):
    """Where a posterior comes from.

    Attributes
    ----------
    command : str
        That made it.
    inputs : mapping of str to str
        Input files and their SHA-256.
    """

    command: str = "from Python"
    inputs: Mapping[str, str | None] = {}


class Checkpoint(NamedTuple):
    """All that is needed to go on as if nothing had happened.

    Attributes
    ----------
    chain, log_prob : array, shape (steps, walkers, n) and (steps, walkers)
        Every step, the warm-up included.
    accepted : array, shape (walkers,)
        Proposals taken.
    accepted_before : array, shape (walkers,)
        Of these, before `began`.
    random_state : tuple
        Of numpy's Mersenne twister, after the last step.
    proposal : Proposal
        Of the leaps.
    share : float
        Of steps that leap.
    began : int
        Step at which this proposal came into use.
    producing : bool
        Whether the warm-up is over, so that the chain from `began` on counts.
    seed : int
        The chain began with.
    """

    chain: np.ndarray
    log_prob: np.ndarray
    accepted: np.ndarray
    accepted_before: np.ndarray
    random_state: tuple
    proposal: Proposal
    share: float
    began: int
    producing: bool
    seed: int


def _text(group: h5py.Group, fields: Mapping[str, Any]) -> None:
    for name, value in fields.items():
        group.attrs[name] = value if isinstance(value, str) else json.dumps(value)


def _write(
    place: Path,
    target: Target,
    state: Checkpoint,
    provenance: Provenance,
    summary: Mapping[str, Any] | None,
) -> None:
    import h5py

    with h5py.File(place, "w") as file:
        file.attrs["format"] = FORMAT
        file.attrs["problem"] = target.digest
        group = file.create_group("mcmc")  # the layout of emcee.backends.HDFBackend
        steps, walkers, n = state.chain.shape
        attributes = {
            "version": version("emcee"),
            "nwalkers": walkers,
            "ndim": n,
            "has_blobs": False,
            "iteration": steps,
        }
        attributes |= {f"random_state_{i}": part for i, part in enumerate(state.random_state)}
        attributes |= {"names": list(target.names), "units": list(target.units)}
        attributes |= {"began": state.began, "producing": state.producing}
        for name, value in attributes.items():
            group.attrs[name] = value
        group.create_dataset("accepted", data=state.accepted)
        group.create_dataset("accepted_before", data=state.accepted_before)
        group.create_dataset("chain", data=state.chain, maxshape=(None, walkers, n))
        group.create_dataset("log_prob", data=state.log_prob, maxshape=(None, walkers))

        proposal = file.create_group("proposal")
        proposal.attrs["share"] = state.share
        proposal.create_dataset("centre", data=state.proposal.widening.centre)
        proposal.create_dataset("source", data=state.proposal.widening.source)
        pairs = zip(state.proposal.blocks, state.proposal.parts, strict=True)
        for number, (block, part) in enumerate(pairs):
            one = proposal.create_group(f"part_{number:03d}")
            one.attrs["degrees"] = part.degrees
            one.create_dataset("numbers", data=block)
            one.create_dataset("location", data=part.location)
            one.create_dataset("root", data=part.root)

        observed = file.create_group("observed")
        for name, values in target.observed.items():
            values = np.asarray(values)
            text = values.dtype.kind in "UO"
            observed.create_dataset(name, data=values.astype(object) if text else values)
        fit = file.create_group("fit")
        _text(fit, {"status": target.verdict[0], "message": target.verdict[1]})
        fit.attrs["names"] = list(target.names)
        for name in ("mode", "covariance", "lower", "upper"):
            fit.create_dataset(name, data=getattr(target, name))
        posterior = file.create_group("posterior")
        finished = summary is not None
        _text(posterior, {"finished": finished, "summary": summary or {}})
        _text(
            file.create_group("provenance"),
            {
                "versions": {name: version(name) for name in PACKAGES}
                | {"python": platform.python_version(), "beamfit": _own_version()},
                "seed": str(state.seed),
                "inputs": dict(provenance.inputs),
                "command": provenance.command,
            },
        )
        file.flush()


def _own_version() -> str:
    from beamfit import __version__

    return __version__


def save(
    path: str | PathLike[str],
    target: Target,
    state: Checkpoint,
    provenance: Provenance,
    summary: Mapping[str, Any] | None = None,
) -> float:
    """Write a checkpoint so that the file is the old one or the whole new one at any moment.

    Parameters
    ----------
    path : str or path
        Where to.
    target : Target
        What is sampled.
    state : Checkpoint
        How far it came.
    provenance : Provenance
        Where it comes from.
    summary : mapping, optional
        The result as JSON's types, once the chain is finished.

    Returns
    -------
    float
        Seconds it took.

    Raises
    ------
    InputError
        If the place cannot be written.
    """
    began = time.perf_counter()
    path = Path(path)
    # One name for all attempts: what a killed process left is overwritten, not collected.
    beside = path.with_name(f".{path.name}.partial")
    try:
        _write(beside, target, state, provenance, summary)
        with open(beside, "rb+") as stream:
            os.fsync(stream.fileno())
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        cause = error.strerror or "no room, or no permission"
        raise InputError(
            f"a store that cannot be written ({cause})", "a writable path", path=path
        ) from None
    return time.perf_counter() - began


def load(path: str | PathLike[str], target: Target, seed: int, walkers: int) -> Checkpoint | None:
    """Read a checkpoint of the same problem; the file is opened for reading only.

    Parameters
    ----------
    path : str or path
        The store.
    target : Target
        What is to be sampled.
    seed, walkers : int
        As of the run that began it.

    Returns
    -------
    Checkpoint or None
        None if there is no such file yet.

    Raises
    ------
    InputError
        If the file is damaged, not a store of beamfit's, or of another problem, seed or number of
        walkers. It is left as it is.
    """
    if not os.path.exists(path):
        return None
    import h5py

    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                found = "an HDF5 file that beamfit did not write"
                raise InputError(found, f"a posterior store ({FORMAT}){REMEDY}", path=path)
            _check_same(file, path, target, seed, walkers)
            return _checkpoint(file)
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError, TypeError, KeyError, AttributeError):
        raise InputError(
            "a file that is not HDF5, or is damaged", f"a posterior store{REMEDY}", path=path
        ) from None


def _check_same(
    file: h5py.File, path: str | PathLike[str], target: Target, seed: int, walkers: int
) -> None:
    """Refuse to continue another problem."""
    names = tuple(str(name) for name in file["mcmc"].attrs["names"])
    if names != target.names:
        found = f"the posterior of other numbers, {', '.join(names)}"
        raise InputError(found, f"one of {', '.join(target.names)}{REMEDY}", path=path)
    if file.attrs["problem"] != target.digest:
        found = "the posterior of another problem (other data, bounds, priors or likelihood)"
        raise InputError(found, f"one of the present problem{REMEDY}", path=path)
    began = int(file["provenance"].attrs["seed"])
    if began != seed:
        raise InputError(f"a chain begun with seed {began}", f"seed {seed}{REMEDY}", path=path)
    found = int(file["mcmc"].attrs["nwalkers"])
    if found != walkers:
        raise InputError(f"a chain of {found} walkers", f"{walkers}{REMEDY}", path=path)


def _checkpoint(file: h5py.File) -> Checkpoint:
    group, proposal = file["mcmc"], file["proposal"]
    steps = int(group.attrs["iteration"])
    chain, log_prob = group["chain"][:], group["log_prob"][:]
    if chain.shape[:2] != log_prob.shape or len(chain) != steps:
        raise ValueError("sizes that do not agree")
    kind, keys, *rest = (group.attrs[f"random_state_{i}"] for i in range(5))
    random_state = (str(kind), keys, int(rest[0]), int(rest[1]), float(rest[2]))
    parts = [one for name, one in sorted(proposal.items()) if name.startswith("part_")]
    return Checkpoint(
        chain=chain,
        log_prob=log_prob,
        accepted=group["accepted"][:],
        accepted_before=group["accepted_before"][:],
        random_state=random_state,
        proposal=Proposal(
            Widening(proposal["centre"][:], proposal["source"][:]),
            tuple(part["numbers"][:] for part in parts),
            tuple(
                Student(part["location"][:], part["root"][:], float(part.attrs["degrees"]))
                for part in parts
            ),
        ),
        share=float(proposal.attrs["share"]),
        began=int(group.attrs["began"]),
        producing=bool(group.attrs["producing"]),
        seed=int(file["provenance"].attrs["seed"]),
    )


def finished(path: str | PathLike[str]) -> bool:
    """Whether a store holds a finished chain with its summary."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return file["posterior"].attrs["finished"] == "true"
    except (OSError, KeyError):
        return False
