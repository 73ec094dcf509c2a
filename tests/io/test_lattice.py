"""Lattice files: what they mean, and that every error names its line."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamfit.errors import InputError
from beamfit.io.line import build_line, load_lattice, read_lattice
from beamfit.optics.calibration import CurrentPolynomial, IntegratedGradient, SlopeIntercept
from beamfit.optics.elements import Drift, Marker, Quadrupole, Screen, SectorDipole, ThinLens
from beamfit.particles import PROTON_MASS, REST_ENERGY

# Every element and every key once; the line numbers below count on it.
WHOLE = """format = "beamfit-lattice-1"
name = "all of it"
source = "this test"
energy_MeV = 1200
particle = "proton"
energy_spread = 1e-3

[design]
at = "S"
x = { beta_m = 1.5, alpha = -0.2 }

[[element]]
type = "quadrupole"
name = "QL"
length_m = 0.1
current_A = 2
slope = 100.0
intercept = 3.0

[[element]]
type = "drift"
length_m = 1

[[element]]
type = "quadrupole"
name = "QP"
length_m = 0.2
current_A = -1.0
gradient_polynomial_T_per_m = [0.1, 2, -0.01]
signed_intercept = true

[[element]]
type = "thin_lens"
name = "L"
k1l_per_m = 0.5

[[element]]
type = "sector_dipole"
name = "B"
bend_plane = "y"
radius_m = 0.4
angle_deg = 60.0
entrance_edge_deg = 2.5
exit_edge_deg = 13.5
energy_offset = 0.01
k1_per_m2 = 0.3

[[element]]
type = "marker"
name = "M"

[[element]]
type = "quadrupole"
name = "QG"
length_m = 0.1
integrated_gradient_kG = -3.0

[[element]]
type = "screen"
name = "S"
resolution_um = 5
"""


@pytest.fixture
def write(tmp_path):
    def to_file(text):
        path = tmp_path / "line.toml"
        path.write_text(text)
        return path

    return to_file


def test_every_key_is_understood(write):
    file = read_lattice(write(WHOLE))
    assert file.places == ["M", "S"]
    assert file.default_screen == "S"
    assert file.calibrations == {"QL": "A", "QP": "A", "L": "k1l", "QG": "kG"}
    line = build_line(file)
    assert (line.name, line.energy, line.energy_spread) == ("all of it", 1200.0, 1e-3)
    assert line.mass == PROTON_MASS
    assert line.design.at == "S"
    assert line.design.x == (1.5, -0.2)
    ql, drift, qp, lens, bend, marker, qg, screen = line.elements
    assert ql == Quadrupole("QL", 0.1, 2.0, SlopeIntercept(100.0, 3.0))
    assert drift == Drift("drift2", 1.0)
    polynomial = CurrentPolynomial((0.1, 2.0, -0.01), signed_intercept=True, mass=PROTON_MASS)
    assert qp == Quadrupole("QP", 0.2, -1.0, polynomial)
    assert lens == ThinLens("L", 0.5)
    angles = np.radians([60.0, 2.5, 13.5]).tolist()
    assert bend == SectorDipole("B", 0.4, *angles, "y", 0.01, 0.3, mass=PROTON_MASS)
    assert marker == Marker("M")
    assert qg == Quadrupole("QG", 0.1, -3.0, IntegratedGradient(mass=PROTON_MASS))
    assert screen == Screen("S", 1e-6 * 5)


def test_a_bend_the_other_way_turns_the_dispersion(write):
    there, back = (
        load_lattice(write(WHOLE.replace("angle_deg = 60.0", f"angle_deg = {a}")))["B"]
        for a in (60.0, -60.0)
    )
    assert back.length == pytest.approx(there.length)
    edges = {"entrance_edge": -there.entrance_edge, "exit_edge": -there.exit_edge}
    mirror = replace(back, **edges)
    ours, mirrored = (bend.matrix(energy=1200.0).y for bend in (there, mirror))
    np.testing.assert_allclose(mirrored[:2, :2], ours[:2, :2], atol=1e-12)
    np.testing.assert_allclose(mirrored[:2, 2], -ours[:2, 2], atol=1e-12)
    assert abs(ours[0, 2]) > 0.1


@pytest.mark.parametrize("name", ["gtf", "lcls_otr2"])
def test_lattices_that_come_along(name, root):
    line = load_lattice(root / f"lattices/{name}.toml")
    assert line.screens
    assert line.magnets


def test_the_last_screen_counts_and_names_are_given(write):
    more = '[[element]]\ntype = "screen"\nname = "S2"\n[[element]]\ntype = "drift"\nlength_m = 1\n'
    file = read_lattice(write(WHOLE + more))
    assert file.default_screen == "S2"
    assert file.elements[-1]["name"] == "drift10"


# (replace, by) -> (line, column named, words)
ERRORS = {
    "format": (('lattice-1"', 'lattice-9"'), 1, "format", "beamfit-lattice-1"),
    "no format": (('format = "beamfit-lattice-1"\n', ""), 1, "format", "beamfit-lattice-1"),
    "syntax": (("slope = 100.0", "slope = "), 17, None, "TOML"),
    "twice": (("slope = 100.0", "slope = 1.0\nslope = 2.0"), 18, None, "TOML"),
    "not closed": (("[0.1, 2, -0.01]", "[0.1, 2"), 30, None, "TOML"),
    "no energy": (("energy_MeV = 1200\n", ""), 1, None, "energy_MeV"),
    "energy below rest": (("energy_MeV = 1200", "energy_MeV = 1.2"), 4, "energy_MeV", "GeV"),
    "energy as text": (("= 1200", '= "1.2 GeV"'), 4, "energy_MeV", "a number"),
    "energy infinite": (("= 1200", "= inf"), 4, "energy_MeV", "a number"),
    "particle": (('"proton"', '"muon"'), 5, "particle", "positron"),
    "another table": (("[design]", "[desing]"), 8, "desing", "did you mean design?"),
    "negative spread": (("= 1e-3", "= -1e-3"), 6, "energy_spread", "between 0"),
    "unknown key at the top": (("source", "sorce"), 3, "sorce", "did you mean source?"),
    "design at": (('at = "S"', 'at = "T"'), 9, "at", "S"),
    "design plane": (("x = {", "z = {"), 10, "z", "x"),
    "design beta": (("beta_m = 1.5", "beta_m = -1.5"), 10, "x", "beta_m > 0"),
    "design text": (("alpha = -0.2", 'alpha = "a"'), 10, "x", "alpha"),
    "design key": (("alpha = -0.2", "alfa = -0.2"), 10, "x", "alpha"),
    "no type": (('type = "marker"\n', ""), 48, None, "marker"),
    "unknown type": (('"marker"', '"mark"'), 49, "type", "did you mean marker?"),
    "no length": (("length_m = 0.1\ncurrent_A", "current_A"), 12, None, "length_m"),
    "negative length": (("length_m = 1\n", "length_m = -1\n"), 22, "length_m", "positive"),
    "zero length": (("length_m = 0.2", "length_m = 0"), 27, "length_m", "positive"),
    "text for a number": (("length_m = 0.2", 'length_m = "20 cm"'), 27, "length_m", "a number"),
    "number for text": (('name = "QP"', "name = 7"), 26, "name", "text"),
    "truth for a number": (("current_A = 2", "current_A = true"), 16, "current_A", "a number"),
    "number for truth": (("= true", "= 1"), 30, "signed_intercept", "true or false"),
    "unknown key": (
        ("signed_intercept", "singed_intercept"),
        30,
        "singed_intercept",
        "did you mean signed_intercept?",
    ),
    "unit in a key": (("radius_m", "radius_mm"), 41, "radius_mm", "did you mean radius_m?"),
    "NaN": (("angle_deg = 60.0", "angle_deg = nan"), 42, "angle_deg", "a number"),
    "no angle": (("angle_deg = 60.0", "angle_deg = 0.0"), 42, "angle_deg", "drift"),
    "bend plane": (('bend_plane = "y"', 'bend_plane = "vertical"'), 40, "bend_plane", "x or y"),
    "slice at rest": (("offset = 0.01", "offset = -0.3"), 45, "energy_offset", "rest energy"),
    "slice that turns back": (
        ("offset = 0.01", "offset = -0.2"),
        45,
        "energy_offset",
        "through the exit face",
    ),
    "no setting": (
        ("k1l_per_m = 0.5\n", ""),
        32,
        None,
        "k1l_per_m; k1l_per_m = 0 where every row of a scan sets it",
    ),
    "two settings": (
        ("k1l_per_m = 0.5", "k1l_per_m = 0.5\nintegrated_gradient_kG = 1"),
        35,
        None,
        "integrated_gradient_kG and k1l_per_m",
    ),
    "half a calibration": (("intercept = 3.0\n", ""), 16, "current_A", "slope and intercept"),
    "two calibrations": (
        ("intercept = 3.0", "intercept = 3.0\ngradient_polynomial_T_per_m = [0.0, 1.0]"),
        16,
        "current_A",
        "slope",
    ),
    "calibration without current": (
        ("k1l_per_m = 0.5", "k1l_per_m = 0.5\nslope = 1.0"),
        36,
        "slope",
        "k1l_per_m",
    ),
    "kG and a slope": (
        ("kG = -3.0", "kG = -3.0\nslope = 1.0\nintercept = 0.0"),
        56,
        "integrated_gradient_kG",
        "current_A",
    ),
    "short polynomial": (("[0.1, 2, -0.01]", "[0.1]"), 29, "gradient_polynomial_T_per_m", "two"),
    "text in a polynomial": (
        ("[0.1, 2, -0.01]", '[0.1, "2"]'),
        29,
        "gradient_polynomial_T_per_m",
        "numbers",
    ),
    "infinite polynomial": (
        ("[0.1, 2, -0.01]", "[0.1, inf]"),
        29,
        "gradient_polynomial_T_per_m",
        "numbers",
    ),
    "sign without a polynomial": (
        ("intercept = 3.0", "intercept = 3.0\nsigned_intercept = true"),
        19,
        "signed_intercept",
        "polynomial",
    ),
    "name twice": (('name = "M"', 'name = "QP"'), 50, "name", "element 3 has it"),
    "name empty": (('name = "M"', 'name = ""'), 50, "name", "a name"),
    "negative resolution": (
        ("resolution_um = 5", "resolution_um = -5"),
        61,
        "resolution_um",
        "zero or more",
    ),
    "not a list of tables": (
        (WHOLE[WHOLE.index("[design]") :], "element = [1, 2]\n"),
        8,
        "element",
        "[[element]]",
    ),
    "no element": (
        (WHOLE[WHOLE.index("[design]") :], "element = []\n"),
        8,
        "element",
        "[[element]]",
    ),
}


@pytest.mark.parametrize("case", ERRORS)
def test_an_error_names_its_line(case, write):
    (old, new), line, column, word = ERRORS[case]
    assert WHOLE.count(old) == 1
    path = write(WHOLE.replace(old, new))
    with pytest.raises(InputError) as raised:
        read_lattice(path)
    error = raised.value
    assert word in str(error)
    assert str(error).startswith(f"{path}:{line}: ")
    if column is not None:
        assert error.column == column


def test_options_of_other_files_are_refused(write):
    for option in ({"use": "LC"}, {"energy": 135.0}):
        with pytest.raises(InputError, match=f"--{next(iter(option))} for a TOML lattice"):
            read_lattice(write(WHOLE), **option)


def read_or_refuse(path):
    try:
        return load_lattice(path)
    except InputError as error:
        said = str(error)
    assert str(path) in said
    assert "\n" not in said
    return None


@given(st.one_of(st.binary(max_size=300), st.text(max_size=300).map(str.encode)))
def test_any_bytes_are_read_or_refused(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "fuzz.toml"
    path.write_bytes(content)
    read_or_refuse(path)


VALUES = [
    "1",
    "-1.5",
    "nan",
    '"x"',
    "true",
    "[]",
    "[1, 2]",
    "{}",
    "[[1]]",
    "{ a = 1 }",
    "1979-05-27",
    "'S'",
    "[{}]",
    "1e999",
    "-inf",
    '""',
]


@given(st.integers(0, WHOLE.count(" = ") - 1), st.sampled_from(VALUES))
def test_any_value_of_any_key_is_read_or_refused(tmp_path_factory, index, value):
    lines = WHOLE.split("\n")
    at = [i for i, t in enumerate(lines) if " = " in t][index % 40]
    lines[at] = lines[at].split(" = ")[0] + f" = {value}"
    path = tmp_path_factory.getbasetemp() / "values.toml"
    path.write_text("\n".join(lines))
    read_or_refuse(path)


@given(st.lists(st.integers(0, WHOLE.count("\n") - 1), min_size=1, max_size=5))
def test_any_lines_left_out_are_read_or_refused(tmp_path_factory, left_out):
    lines = [t for i, t in enumerate(WHOLE.split("\n")) if i not in left_out]
    path = tmp_path_factory.getbasetemp() / "lines.toml"
    path.write_text("\n".join(lines))
    read_or_refuse(path)


def in_lattice(tmp_path, quadrupole, top="energy_MeV = 135.0"):
    path = tmp_path / "line.toml"
    path.write_text(
        f'format = "beamfit-lattice-1"\n{top}\n[[element]]\ntype = "quadrupole"\nname = "Q"\n'
        f'length_m = 0.2\n{quadrupole}\n[[element]]\ntype = "screen"\nname = "S"\n'
    )
    return path


MEASURED = [(-2.0, -4.1), (0.0, 0.2), (1.0, 2.3), (3.0, 5.9)]


@pytest.mark.parametrize(
    ("column", "factor"),
    [("gradient_T_per_m", 1.0), ("integrated_gradient_T", 0.2), ("integrated_gradient_kG", 2.0)],
)
def test_a_measured_gradient_is_followed_between_its_points(column, factor, tmp_path):
    pairs = [list(p) for p in MEASURED]
    inline = load_lattice(in_lattice(tmp_path, f"current_A = 0\ngradient_table = {pairs}"))
    rows = [f"{i};{factor * g!r}" for i, g in reversed(MEASURED)]
    (tmp_path / "q.csv").write_text("\n".join([f"# coil 3\ncurrent_A;{column}", *rows]))
    said = 'current_A = 0\ngradient_table_file = "q.csv"'
    from_file = load_lattice(in_lattice(tmp_path, said))
    currents, gradients = np.transpose(MEASURED)
    for current in np.linspace(-2.0, 3.0, 11):
        expected = np.interp(current, currents, gradients)
        for line in (inline, from_file):
            k1 = float(line["Q"].k1(current, 135.0))
            # Bρ = p/(0.299792458 GeV/c per T m)
            p = np.sqrt(135.0**2 - 0.51099895069**2) / 299.792458
            assert k1 == pytest.approx(expected / p, rel=1e-12)
    assert from_file["Q"].calibration.unit == "A"


@pytest.mark.parametrize(
    ("quadrupole", "words"),
    [
        ("current_A = 0\ngradient_table = [[0, 1]]", "1 points"),
        ("current_A = 0\ngradient_table = [[0, 1], [1, 2], [0, 3]]", "0 A twice"),
        ("current_A = 0\ngradient_table = [[0, 1], [1]]", "pairs"),
        ('current_A = 0\ngradient_table = [[0, 1], [1, "2"]]', "pairs"),
        ("current_A = 0\ngradient_table = [[0, 1], [1, 2]]\nslope = 1.0", "without one"),
        ("k1_per_m2 = 0\ngradient_table = [[0, 1], [1, 2]]", "no calibration"),
        ('current_A = 0\ngradient_table_file = "none.csv"', "none.csv: no such file"),
        ('current_A = 0\ngradient_table_file = "bad.csv"', "bad.csv:1: .*current_A and one of"),
        ("gradient_T_per_m = 1\nk1_per_m2 = 2", "both"),
    ],
)
def test_gradient_tables_that_cannot_be_used(quadrupole, words, tmp_path):
    (tmp_path / "bad.csv").write_text("current_A\n1\n2\n")
    with pytest.raises(InputError, match=words):
        read_lattice(in_lattice(tmp_path, quadrupole))


@pytest.mark.parametrize("particle", ["electron", "proton", "H-", "deuteron"])
def test_momentum_and_kinetic_energy_of_the_lattice(particle, tmp_path):
    rest = REST_ENERGY[particle]
    total = rest + 70.0
    momentum = np.sqrt(total**2 - rest**2)
    for key, value in (
        ("energy_MeV", total),
        ("kinetic_energy_MeV", 70.0),
        ("momentum_MeV", float(momentum)),
    ):
        top = f'{key} = {value!r}\nparticle = "{particle}"'
        found = read_lattice(in_lattice(tmp_path, "gradient_T_per_m = 1.5", top))
        assert found.energy == pytest.approx(total, rel=1e-14)
        assert found.calibrations == {"Q": "T_per_m"}
        # k1 = G/(Bρ)
        k1 = float(build_line(found)["Q"].k1(energy=found.energy))
        assert k1 == pytest.approx(1.5 * 299.792458 / momentum, rel=1e-12)
    for top in (
        "kinetic_energy_MeV = -1",
        "momentum_MeV = 0",
        "energy_MeV = 135\nmomentum_MeV = 1",
    ):
        with pytest.raises(InputError) as raised:
            read_lattice(in_lattice(tmp_path, "k1_per_m2 = 1", top))
        assert raised.value.column in top
