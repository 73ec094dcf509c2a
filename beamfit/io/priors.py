"""Priors of a laboratory as TOML files: on the noise of sizes, and on screen, beam and line."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Any

from beamfit.errors import InputError
from beamfit.io.toml import LIST, NUMBER, NUMBERS, TABLE, TEXT, Key, Section, is_number, read_toml
from beamfit.noise.model import Noise
from beamfit.writing import write_atomically

if TYPE_CHECKING:
    from beamfit.noise.learn import Learned

NOISE_FORMAT, SYSTEMATICS_FORMAT = "beamfit-noise-1", "beamfit-systematics-1"
# Fields of `Noise` with a median and a spread, and those with one number.
PAIRS = ("factor", "unstated", "scatter")
NUMBER_FIELDS = ("right", "share", "even", "bad", "width", "bad_shot")
PAIR_TEXT = "two numbers: the middle and the standard deviation of the logarithm"
# Key of the file -> name of the number, and SI value of one unit.
TERMS = {
    "size_scale": ("size_scale", 1.0),
    "resolution_um": ("resolution", 1e-6),
    "wire_diameter_um": ("wire", 1e-6),
    "energy": ("energy", 1.0),
    "dispersion_m": ("dispersion", 1.0),
    "dispersion_slope": ("dispersion_slope", 1.0),
}
# Table with elements as keys -> quantity, and SI value of one unit.
TABLES = {"gradient": ("gradient", 1.0), "length_mm": ("length", 1e-3)}
PRIOR_TEXT = "a standard deviation, or a list of mean and standard deviation"


def read_noise(path: str | PathLike[str]) -> Noise:
    """Read priors on the noise of beam sizes.

    Parameters
    ----------
    path : str or path
        A TOML file with any of the fields of `beamfit.Noise`; ``factor``, ``unstated`` and
        ``scatter`` are lists of the middle and the standard deviation of the logarithm.

    Returns
    -------
    Noise
        With beamfit's defaults for missing fields.

    Raises
    ------
    InputError
        Naming file, line and key.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "noise.toml"
    >>> _ = file.write_text('scatter = [0.03, 0.5]\\nsource = "our OTR screens, 2026"\\n')
    >>> read_noise(file).scatter.middle
    0.03
    """
    top = read_toml(path, "priors of noise", NOISE_FORMAT, needed=False)
    schema = {name: Key(name, default=None) for name in NUMBER_FIELDS}
    schema |= {
        name: Key(name, kind=LIST, default=None, expected=PAIR_TEXT, each=NUMBER) for name in PAIRS
    }
    values = top.values(schema | {"source": Key("source", kind=TEXT, default=str(path))})
    given: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
    for name, value in given.items():
        if name in PAIRS and len(value) != 2:
            raise top.error(f"{name} = {value}", PAIR_TEXT, name)
        try:
            Noise(**{name: value})
        except InputError as error:
            raise top.error(error.found, error.expected, name) from None
    return Noise(**given)


def write_noise(path: str | PathLike[str], learned: Learned) -> None:
    """Write learned priors, with their errors as comments.

    Parameters
    ----------
    path : str or path
        The file; an existing one is replaced atomically.
    learned : Learned
        Result of `beamfit.noise.learn.learn_noise`.
    """
    lines = [
        f'format = "{NOISE_FORMAT}"',
        f'source = "{learned.noise.source}"',
        "# What was learned, with standard errors; the rest is beamfit's own.",
    ]
    for name in (*NUMBER_FIELDS, *PAIRS):
        value = getattr(learned.noise, name)
        text = f"[{value[0]:.4g}, {value[1]:.4g}]" if name in PAIRS else f"{value:.4g}"
        comment = f"  # {learned.errors[name]}" if name in learned.errors else ""
        lines.append(f"{name} = {text}{comment}")
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def read_systematics(path: str | PathLike[str]) -> dict[str, tuple[float | None, float]]:
    """Read priors on screen, beam and line.

    Parameters
    ----------
    path : str or path
        A TOML file with any of ``size_scale``, ``resolution_um``, ``wire_diameter_um``,
        ``energy``, ``dispersion_m``, ``dispersion_slope``, and the tables ``gradient`` and
        ``length_mm`` with elements as keys. Each value is a standard deviation, or a list of mean
        and standard deviation. Scales and gradients are relative: 0.02 is 2 %.

    Returns
    -------
    dict of str to (float or None, float)
        As ``priors`` of `beamfit.fit_emittance`; a mean of None is the value of the line.

    Raises
    ------
    InputError
        Naming file, line and key.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "known.toml"
    >>> _ = file.write_text("energy = 0.02\\ndispersion_m = [0.1, 0.02]\\n[gradient]\\nQ = 0.01")
    >>> read_systematics(file)
    {'energy': (None, 0.02), 'dispersion': (0.1, 0.02), 'Q.gradient': (None, 0.01)}
    """
    top = read_toml(path, "systematics", SYSTEMATICS_FORMAT, needed=False)
    schema = {name: Key(default=None, kind=NUMBERS) for name in TERMS}
    schema |= {name: Key(kind=TABLE, default=None) for name in TABLES}
    top.values(schema)
    found = {
        name: _prior(top, key, factor) for key, (name, factor) in TERMS.items() if key in top.table
    }
    for key, (quantity, factor) in TABLES.items():
        if key in top.table:
            section = top.section(key)
            found |= {f"{name}.{quantity}": _prior(section, name, factor) for name in section.table}
    if not found:
        raise top.error("a file that says nothing", f"one of {', '.join((*TERMS, *TABLES))}")
    return found


def _prior(section: Section, key: str, factor: float) -> tuple[float | None, float]:
    """Mean (None if not given) and standard deviation of a prior, in SI."""
    given: Any = section.table[key]
    numbers = given if isinstance(given, list) else [None, given]
    is_pair = len(numbers) == 2 and all(n is None or is_number(n) for n in numbers)
    if not is_pair or not numbers[1] > 0:
        raise section.error(f"{key} = {given}", PRIOR_TEXT, key)
    mean, sd = numbers
    return None if mean is None else factor * mean, factor * sd
