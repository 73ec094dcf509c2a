"""Job of a batch: hundreds of files at a time, wherever they run, a row for each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import beamfit
from beamfit.batch.columns import COLUMNS, UNUSABLE, decay_row, emittance_rows, lifetime_rows, lines
from beamfit.errors import InputError
from beamfit.io.decay_record import read_lifetime_input
from beamfit.io.files import digest
from beamfit.io.lattice import LatticeFile
from beamfit.io.line import Inputs, build_line, read_inputs, read_lattice
from beamfit.io.priors import read_noise
from beamfit.lifetime.record import LifetimeTable
from beamfit.noise.learn import Learned, learn_noise
from beamfit.noise.model import Noise

if TYPE_CHECKING:
    from beamfit.optics.beamline import Beamline


class _Lattice(NamedTuple):
    file: LatticeFile
    line: Beamline


@lru_cache(maxsize=4)  # scans of one line share what it is made into
def _lattice(path: str, sha256: str, part: tuple[tuple[str, Any], ...]) -> _Lattice:
    file = read_lattice(path, **dict(part))
    if file.sha256 != sha256:
        raise InputError("a lattice that was changed meanwhile", "the one of the start", path=path)
    return _Lattice(file, build_line(file))


@dataclass(frozen=True)
class Job:
    """The question a batch puts to every file: kind of fit, line, options.

    Parameters
    ----------
    kind : {"emittance", "lifetime"}
        What the files hold.
    lattice : str, optional
        The line of the scans; rows with matrices of their own need none.
    part : mapping
        ``use, energy, particle, first, last, screen`` of `beamfit.io.line.read_inputs`.
    reading : mapping
        How files are read: ``columns, ignore, skip_bad``.
    weights : {"model", "measured"}
        As for `beamfit.fit_emittance`.
    noise : str, optional
        File of priors on the noise of sizes; beamfit's own without.

    Raises
    ------
    InputError
        If the lattice cannot be read.

    Examples
    --------
    >>> Job("emittance", "lattices/lcls_otr2.toml").kind
    'emittance'
    """

    kind: str
    lattice: str | None = None
    part: Mapping[str, Any] = field(default_factory=dict)
    reading: Mapping[str, Any] = field(default_factory=dict)
    weights: str = "model"
    lattice_sha256: str = ""
    noise: str | None = None
    version: str = beamfit.__version__

    def __post_init__(self) -> None:
        for name in ("part", "reading"):
            told = {k: v for k, v in getattr(self, name).items() if v not in (None, (), False)}
            object.__setattr__(self, name, told)
        if self.lattice is not None and not self.lattice_sha256:
            found = read_lattice(self.lattice, **self.part).sha256
            object.__setattr__(self, "lattice_sha256", found)

    @property
    def key(self) -> tuple[str, str, str]:
        """Inputs of an answer besides the file: lattice, options, version."""
        said = {**self.part, **self.reading, "weights": self.weights}
        said |= {} if self.noise is None else {"noise": digest(self.noise)}
        words = (f"{k}={' '.join(v) if isinstance(v, tuple) else v}" for k, v in said.items())
        return self.lattice_sha256, ", ".join(words), self.version

    def answer(self, files: Sequence[str]) -> str:
        """Answer for some files, in lines of CSV; what goes wrong with one is a row of its own."""
        if beamfit.__version__ != self.version:
            raise InputError(f"beamfit {beamfit.__version__} on a worker", f"{self.version} there")
        try:
            found = self._emittances(files) if self.kind == "emittance" else self._decays(files)
            key = dict(zip(("lattice_sha256", "options", "beamfit"), self.key, strict=True))
            return lines((row | key for row in found), COLUMNS[self.kind])
        except Exception as error:
            if len(files) > 1:
                return "".join(self.answer([file]) for file in files)
            said = f"an error in beamfit, please report it: {type(error).__name__}: {error}"
            return self.refused(files[0], said)

    def refused(self, file: str, reason: str) -> str:
        """The line of a file that has no answer."""
        key = dict(zip(("lattice_sha256", "options", "beamfit"), self.key, strict=True))
        return lines([_refused(file, reason) | key], COLUMNS[self.kind])

    def read(self, file: str) -> Inputs:
        """A scan and its lattice."""
        if self.lattice is None:
            return read_inputs(file, **self.part, **self.reading)
        return read_inputs(file, self._line().file, **self.reading)

    def _line(self) -> _Lattice:
        return _lattice(self.lattice, self.lattice_sha256, tuple(self.part.items()))

    def line_of(self, found: Inputs) -> Beamline:
        """The line of a scan."""
        own = self.lattice is not None and found.lattice is self._line().file
        return self._line().line if own else build_line(found.lattice)

    def fit(self, file: str) -> Any:
        """Result of one file, as `beamfit.write_report` takes it."""
        if self.kind == "lifetime":
            from beamfit.lifetime.study import study_record

            return (study_record(read_lifetime_input(file, **self.reading)),)
        from beamfit.emittance.slices import fit_slices

        found = self.read(file)
        fit = fit_slices if len(found.scan.slices) > 1 else beamfit.fit_emittance
        return fit(found.scan, self.line_of(found), weights=self.weights, noise=self._priors)

    @property
    def _priors(self) -> Noise:
        return Noise() if self.noise is None else read_noise(self.noise)

    def learned_noise(self, files: Sequence[str]) -> Learned:
        """Learn the noise of all scans that are surely a beam's.

        Raises
        ------
        InputError
            If there are fewer than five planes of a kind.
        """
        from beamfit.emittance.fit import noise_samples

        read = (found for file in files if isinstance(found := _tried(self.read, file), Inputs))
        pairs = [(found.scan, self.line_of(found)) for found in read if len(found.scan.slices) < 2]
        source = f"learned from {len(pairs)} scans by beamfit {self.version}"
        return learn_noise(list(noise_samples(pairs, self._priors)), self._priors, source)

    def _emittances(self, files: Iterable[str]) -> Iterator[dict[str, Any]]:
        from beamfit.emittance.fit import fit_many

        read = [_tried(self.read, file) for file in files]
        parts = []
        for i, found in enumerate(read):
            if isinstance(found, Inputs):
                scan, line = found.scan, self.line_of(found)
                several = len(scan.slices) > 1
                own = [scan.of_slice(name) for name in scan.slices] if several else [scan]
                parts += [(i, (each, line)) for each in own]
        fits: list[list[Any]] = [[] for _ in read]
        for (i, (scan, _)), fit in zip(
            parts, fit_many((p for _, p in parts), self.weights, self._priors), strict=True
        ):
            fits[i].append((scan.slices[0] if scan.slice else "", fit))
        for file, found, own in zip(files, read, fits, strict=True):
            if isinstance(found, InputError):
                yield _refused(file, str(found))
            for name, fit in own:
                about = {"file": file, "sha256": found.scan.sha256, "slice": name}
                if isinstance(fit, InputError):
                    yield about | {"status": UNUSABLE, "message": str(fit)}
                else:
                    yield from (row | about for row in emittance_rows(fit))

    def _decays(self, files: Iterable[str]) -> Iterator[dict[str, Any]]:
        for file in files:
            found = _tried(self._decay_rows, file)
            if isinstance(found, InputError):
                yield _refused(file, str(found))
                continue
            about = {"file": file, "sha256": digest(file)}
            yield from (row | about for row in found)

    def _decay_rows(self, file: str) -> list[dict[str, Any]]:
        from beamfit.lifetime.lifetime_table import fit_lifetimes
        from beamfit.lifetime.study import study_record

        record = read_lifetime_input(file, **self.reading)
        if isinstance(record, LifetimeTable):
            return [decay_row(fit_lifetimes(record).to_json())]
        return list(lifetime_rows(study_record(record)))


def _tried(read: Callable[[str], Any], file: str) -> Any:
    try:
        return read(file)
    except InputError as error:
        return error


def _refused(file: str, reason: str) -> dict[str, Any]:
    try:
        sha256 = digest(file)
    except InputError:  # what cannot be read is tried again by the next run
        sha256 = ""
    return {"file": file, "sha256": sha256, "status": UNUSABLE, "message": reason}
