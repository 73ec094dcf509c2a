"""Lines of MAD-X, MAD-8 and elegant files; pyAT's parsers read the last two, in a process apart."""

from __future__ import annotations

import io
import re
import unicodedata
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any

from beamfit.errors import InputError, nearest
from beamfit.io.files import digest, read_text
from beamfit.io.isolated import isolated
from beamfit.io.lattice import LatticeFile
from beamfit.io.madx_lines import read_madx
from beamfit.io.sequence_elements import NOTHING_AT_ZERO, Source, element_tables, pyat_element
from beamfit.particles import REST_ENERGY, expected_energy

MADX, MAD8, ELEGANT = "MAD-X", "MAD-8", "elegant"
DIALECTS = {
    ".madx": MADX,
    ".seq": MADX,
    ".mad8": MAD8,
    ".mad": MAD8,
    ".lte": ELEGANT,
    ".elegant": ELEGANT,
}
# What the parsers do not know but the programs do, as the type it is like to first order.
ALSO_MAD = {
    "drift": ("rcollimator", "ecollimator", "placeholder", *NOTHING_AT_ZERO),
    "monitor": ("imonitor", "blmonitor", "slmonitor", "instrument", "profile", "wire"),
}
ALSO_ELEGANT = {"MARK": ("WATCH", "MARKER"), "DRIF": ("EDRIFT", "CSRDRIFT", "LSCDRIFT")}
# The parsers evaluate expressions with Python's eval. No lattice needs these words, and code
# that means harm needs one of them.
HARMFUL = re.compile(r"__|_frame|f_back|f_globals|f_builtins")
# pyAT takes the parameters of an element that is alone in an elegant LINE for its members.
ALONE = re.compile(r"(LINE\s*=\s*\([^,()]*)\)", re.IGNORECASE)
# MAD-X takes a name that nobody defines for zero, pyAT does not know it. Kicks and what focuses to
# second order are often such names in published files, and are nothing to a linear line.
NO_MATTER = re.compile(r",\s*(?:[hv]?kick|k[23]s?)\s*:?=\s*[^,;]*", re.IGNORECASE)
# MAD-X reads these words as it reads all others, in either spelling.
REFERENCE = re.compile(r"(\bREFER\s*=\s*)\"?(CENTER|CENTRE|ENTRY|EXIT)\"?", re.IGNORECASE)
# Where a statement did not parse, as pyAT says it.
TOLD = re.compile(r"Line (\d+) (['\"])(.*?)\2, (.*)", re.DOTALL)
ENERGIES = ("energy", "pc", "gamma", "beta", "brho")


def read_sequence(
    path: str | PathLike[str], *, use: str | None = None, energy: float | None = None
) -> LatticeFile:
    """Read a line or sequence of a MAD-X, MAD-8 or elegant file.

    Parameters
    ----------
    path : str or path
        The file: ``.madx``, ``.seq``; ``.mad8``, ``.mad``; ``.lte``.
    use : str, optional
        Name of the LINE or SEQUENCE; not needed where the file has only one.
    energy : float, optional
        Total energy in MeV; overrides the file's BEAM. An elegant file has none.

    Returns
    -------
    LatticeFile
        Element tables as of a TOML lattice. The setting of a quadrupole is its k1 in 1/m².

    Raises
    ------
    InputError
        If pyAT is not installed, the file does not parse, or the line holds an element whose
        focusing beamfit does not model.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "line.lte"
    >>> _ = file.write_text('Q1: QUAD, L=0.1, K1=3\\nS: MONI\\nLC: LINE=(Q1,S)\\n')
    >>> read_sequence(file, energy=135.0).calibrations["Q1"]
    'k1'
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".ele":
        expected = "the lattice file (.lte) that its &run_setup names"
        raise InputError("an elegant command file", expected, path=path)
    if DIALECTS[suffix] == MADX:
        return read_madx(path, use=use, energy=energy)
    source = Source(path, read_text(path), DIALECTS[suffix])
    if find_spec("at") is None:
        found = f"a {source.dialect} file, which needs pyAT to read"
        raise source.error(found, "pip install 'beamfit[lattice]'")
    name, particle, total, elements = isolated(
        "pyAT", path, _valid(source), pyat_line, source, use, energy
    )
    return LatticeFile(path, digest(path), name, total, particle, tuple(elements))


def pyat_line(
    source: Source, use: str | None, energy: float | None
) -> tuple[str, str, float, list[dict[str, Any]]]:
    """Read a line with pyAT; called in a process of its own.

    Returns
    -------
    tuple
        Its name, the particle, its total energy in MeV and the tables of its elements.
    """
    with _silence() as printed:
        try:
            parser = _parser(source)
            _parse(parser, source)
            _check_ignored(printed.getvalue(), source)
            name, key = _chosen(parser, source, use)
            particle, total = _beam(parser, source, name, energy)
            expanded = _expanded(parser, source, name, key)
            said = _descriptions(parser)
            elements = element_tables([pyat_element(e, said, source) for e in expanded])
        except InputError:
            raise
        except Exception as error:  # whatever evaluating an expression may raise, also late
            raise _unparsed(source, error) from None
    if not elements:
        raise source.error(f"'{name}' without elements", "a line with magnets and a screen", name)
    return name, particle, total, elements


@contextmanager
def _silence() -> Iterator[io.StringIO]:
    """Keep what the parser prints and warns of from the user's terminal."""
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield said


def _parser(source: Source) -> Any:
    """Make pyAT's parser of the file's dialect, with the element types it lacks."""
    import at

    kinds = {MAD8: at.Mad8Parser, ELEGANT: at.ElegantParser}
    parser = kinds[source.dialect]()
    env = dict(parser.env)
    for like, names in (ALSO_ELEGANT if source.dialect == ELEGANT else ALSO_MAD).items():
        env |= {n: type(n, (env[like],), {}) for n in names if n not in env or n == "WATCH"}
    if source.dialect == MAD8:  # whose keywords may be cut to four letters
        words = [w for w in env if isinstance(env[w], type) and w not in ("line", "sequence")]
        short = {w[:n]: env[w] for w in words for n in range(4, len(w))}
        env |= {k: v for k, v in short.items() if k not in env}
    parser.env = env
    if source.dialect != ELEGANT:
        # A default energy of 1 GeV would stand in for one that is missing, or given as pc.
        default = {k: v for k, v in parser["beam"].default_beam.items() if k != "energy"}
        parser["beam"].default_beam = MappingProxyType(default)
        parser["beam%"].pop("energy")
    return parser


def _parse(parser: Any, source: Source) -> None:
    statement = parser._statement

    def checked(text: str) -> bool:
        if HARMFUL.search(unicodedata.normalize("NFKC", text)):
            raise ValueError("a name that no lattice needs and that could run code")
        if not _balanced(text):  # on which the parser would never end
            raise ValueError("parentheses that do not match")
        if source.dialect != ELEGANT:
            # pyAT takes 2^3 behind := for the bits of 1.
            text = REFERENCE.sub(_reference, NO_MATTER.sub("", text)).replace("^", "**")
        if source.dialect == ELEGANT:
            parser.rpn.stack.clear()  # a "% 3.7 sto k" leaves its number there
            text = ALONE.sub(r"\1,)", text)
        return statement(text)

    parser._statement = checked
    parser._analyse = lambda key: None  # runs for ever on lines that hold one another
    parser.bases.append(Path(source.path).resolve().parent)  # where CALL looks
    parser.parse_lines(source.text.splitlines(keepends=True), final=False)
    if any(str(said[2]).lower() == "call" for said in parser.postponed):
        raise source.error("a CALL that pyAT does not carry out", "one file with all in it")


def _reference(found: re.Match[str]) -> str:
    return found[1] + found[2].lower().replace("center", "centre")


def _balanced(text: str) -> bool:
    opened = []
    for bracket in re.findall(r"[(){}]", re.sub(r'"[^"]*"', "", text)):
        if bracket in "({":
            opened.append(bracket)
        elif not opened or opened.pop() + bracket not in ("()", "{}"):
            return False
    return not opened


def _unparsed(source: Source, error: Exception) -> InputError:
    """Say which statement did not parse; the parser tells where it ended, counted from 0."""
    told = TOLD.match(str(error))
    if told is None:
        cause = str(error) or type(error).__name__
        return source.error(f"a file that does not parse ({_short(cause)})", _valid(source))
    number, _, text, cause = told.groups()
    while inner := TOLD.match(cause):  # in a file that was called
        cause = inner[4]
    return InputError(
        f"'{_short(text)}' does not parse ({_short(cause)})",
        _valid(source),
        path=source.path,
        line=int(number) + 1,
    )


def _valid(source: Source) -> str:
    return f"a valid {source.dialect} file"


def _short(text: str) -> str:
    text = " ".join(re.sub(r"\s*\(<string>, line 1\)", "", text).split())
    return text if len(text) <= 80 else text[:77] + "..."


def _check_ignored(said: str, source: Source) -> None:
    """Refuse what the parser only mentions and drops, such as TILT without a value."""
    dropped = re.search(r"Unexpected positional argument '(.*)' ignored", said)
    if dropped:
        word = dropped[1]
        pattern = re.compile(rf",\s*{re.escape(word)}\s*(?![\w.]*\s*:?=)", re.IGNORECASE)
        lines = enumerate(source.text.splitlines(), start=1)
        line = next((n for n, t in lines if pattern.search(t)), None)
        raise InputError(
            f"'{_short(word)}' without a value", f"{_short(word)} = ...", source.path, line
        )


def _descriptions(parser: Any) -> dict[str, Any]:
    """Parameters of each element in the file, by name."""
    return {v.name: v for v in parser.values() if hasattr(v, "origin")}


def _key(name: str) -> str:
    """Spell a name as the parser's own bookkeeping does, for comparison only."""
    return re.sub(r"[.:]", "_", name.strip('"')).lower()


def _chosen(parser: Any, source: Source, use: str | None) -> tuple[str, str]:
    """Name and parser key of the line to be read."""
    sequences = set(parser.sequences)
    found = {v.name: k for k, v in parser.items() if k in sequences and getattr(v, "valid", True)}
    pending = [p[1] for p in parser.postponed if p[1] and p[2].lower() in ("line", "sequence")]
    names = list(dict.fromkeys([*found, *pending]))
    if not names:
        raise source.error("no LINE and no SEQUENCE", f"{_valid(source)} with one of them")
    if use is None and len(names) > 1:
        raise source.error(
            f"{len(names)} lines or sequences", f"--use NAME with {nearest('', names)}"
        )
    chosen = names[0] if use is None else next((n for n in names if _key(n) == _key(use)), None)
    if chosen is None:
        raise source.error(f"no line or sequence '{use}'", nearest(str(use), names))
    if chosen not in found:
        raise _undefined(parser, source, chosen)
    return chosen, found[chosen]


def _undefined(parser: Any, source: Source, name: str) -> InputError:
    """Follow why a definition failed down to the word that is not defined."""
    pending = {_key(p[1]): (p[1], _key(str(p[0]))) for p in parser.postponed if p[1]}
    label, cause = pending.get(_key(name), (name, _key(name)))
    seen = {_key(label)}
    while cause in pending and cause not in seen:
        seen.add(cause)
        label, cause = pending[cause]
    kind = next((p[2] for p in parser.postponed if p[1] == label), None)
    if kind is not None and _key(kind) == cause:
        return source.error(
            f"element '{label}' of type '{kind.upper()}', which cannot be read",
            "drifts, quadrupoles, dipoles, monitors and markers; cut the line around it",
            label,
        )
    return source.error(
        f"'{label}', which needs the undefined '{cause}'", f"a definition of '{cause}'", label
    )


def _beam(parser: Any, source: Source, name: str, energy: float | None) -> tuple[str, float]:
    """Particle and total energy in MeV."""
    particle, total = "electron", energy
    if source.dialect != ELEGANT:
        beam = parser.get(f"beam%{name}") or parser["beam%"]
        particle = str(beam["particle"]).lower()
        if energy is None and any(k in beam for k in ENERGIES):
            try:
                total = 1e-6 * float(beam.resolve()["energy"])
            except Exception as error:
                cause = _short(str(error))
                raise source.error(
                    f"a BEAM that cannot be read ({cause})", "energy = ..."
                ) from None
    if particle not in REST_ENERGY:
        raise source.error(f"particle '{particle}'", nearest(particle, list(REST_ENERGY)))
    if total is None:
        where = "" if source.dialect == ELEGANT else "BEAM, ENERGY = or "
        expected = f"{where}--energy in MeV (energy= from Python)"
        raise source.error("no beam energy in the file", expected)
    if expected := expected_energy(total, particle):
        found = f"an energy of {total:g} MeV"
        raise source.error(found, f"{expected}; BEAM is in GeV, --energy in MeV")
    return particle, float(total)


def _check_members(parser: Any, source: Source, members: Any, name: str, seen: set[int]) -> None:
    """Refuse what the parser would drop without a word: numbers in a LINE."""
    line = parser.env.get("line") or parser.env["LINE"]
    for member in members if isinstance(members, line) or type(members) in (tuple, list) else ():
        if isinstance(member, tuple | list):
            if id(member) not in seen:
                seen.add(id(member))
                _check_members(parser, source, member, name, seen)
        elif not hasattr(member, "expand"):
            found = getattr(member, "expr", member)
            raise source.error(f"'{name}' with {found!r} in it", "elements and lines", name)


def _expanded(parser: Any, source: Source, name: str, key: str) -> list[Any]:
    """Return the elements of a line as pyAT's, in order."""
    try:
        _check_members(parser, source, parser[f'"{key}"'], name, set())
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            elements = list(parser.expand(f'"{key}"'))
    except InputError:
        raise
    except Exception as error:
        quoted = re.findall(r"'([\w.:]+)'", str(error.args[0]) if error.args else "")
        waiting = {_key(p[1]) for p in parser.postponed if p[1]}
        for word in quoted:
            if _key(word) in waiting:
                raise _undefined(parser, source, word) from None
        cause = _short(": ".join(str(a) for a in error.args) or type(error).__name__)
        raise source.error(f"'{name}' cannot be expanded ({cause})", _valid(source), name) from None
    for warning in warned:
        if "overlapping" in str(warning.message):
            raise source.error(_short(str(warning.message)), "elements that do not overlap", name)
    return elements
