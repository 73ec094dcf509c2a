"""MAD-X, MAD-8 and elegant lines, against pyAT's and MAD-X's own matrices of the same file."""

import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamfit.errors import InputError
from beamfit.io.line import build_line, load_lattice, read_lattice
from tests.io.forked import in_forks  # noqa: F401
from tests.simulations import simulations

at = pytest.importorskip("at", reason="accelerator-toolbox is not installed")

# A quadrupole, a corrector (at zero: pyAT's matrix is about the kicked orbit), a bend with
# edges and gradient, and a monitor with a length.
MADX = """! a comment: with a colon
beam, particle=electron, energy=0.135;
kq := 3.7;
Q1: quadrupole, l=0.12, k1:=kq;
C1: hkicker, l=0.1, kick=0;
B1: sbend, l=0.4, angle=0.3, e1=0.1, e2=0.05, k1=0.4;
BPM: monitor, l=0.06;
OTR: instrument;
LC: sequence, l=3.0, refer=centre;
Q1, at=0.06;
C1, at=0.5;
B1, at=1.0;
BPM, at=2.0;
OTR, at=3.0;
endsequence;
"""
MAD8 = """COMMENT
 a block
ENDCOMMENT
BEAM, PARTICLE=ELECTRON, ENERGY=0.135
KQ := 3.7
Q1: QUAD, L=0.12, K1=KQ
D1: DRIF, L=0.68
D2: DRIF, L=1.8
B1: SBEN, L=0.4, ANGLE=0.3, E1=0.1, &
    E2=0.05, K1=0.4
OTR: PROF
LC: LINE=(Q1,D1,B1,D2,OTR)
"""
ELEGANT = """! elegant
% 3.7 sto kq
"Q1": KQUAD, L=0.12, K1="kq"
D1: DRIFT, L=0.68
D2: DRIFT, L=1.77
B1: CSBEND, L=0.4, ANGLE=0.3, E1=0.1, &
    E2=0.05, K1=0.4
W1: WATCH, FILENAME="%s.w1"
BPM: MONI, L=0.06
LC: LINE=(Q1,D1,B1,D2,W1,BPM)
"""
FILES = {"line.madx": MADX, "line.mad8": MAD8, "line.lte": ELEGANT}
LOADERS = {"line.madx": at.load_madx, "line.mad8": at.load_mad8, "line.lte": at.load_elegant}
# pyAT knows neither MAD-8's short keywords nor its profile monitors.
FULL = {"QUAD,": "QUADRUPOLE,", "DRIF,": "DRIFT,", "SBEN,": "SBEND,", "PROF": "MONITOR"}
# Nor does it read an expression after "sto", which leaves its number on the stack.
RPN = {"% 3.7 sto kq\n": "\n", '"kq"': "3.7"}


@pytest.fixture
def written(tmp_path):
    def write(name, text):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def refused(path, **options):
    with pytest.raises(InputError) as raised:
        read_lattice(path, **options)
    return str(raised.value)


def planes_of(m66):
    """Both planes of a 6x6 matrix on (x, x', y, y', δ, ct), as beamfit orders them."""
    return m66[np.ix_([0, 1, 4], [0, 1, 4])], m66[np.ix_([2, 3, 4], [2, 3, 4])]


@pytest.mark.filterwarnings("ignore::at.AtWarning")
@pytest.mark.parametrize("name", FILES)
def test_matrix_is_that_of_pyat(name, written):
    ours = load_lattice(written(name, FILES[name]), energy=135.0).matrix()
    text = FILES[name]
    for short, full in FULL.items() if name.endswith("mad8") else RPN.items():
        text = text.replace(short, full)
    ring = LOADERS[name](written("peer_" + name, text), use="LC", energy=135e6)
    for element in ring:
        if hasattr(element, "NumIntSteps"):
            element.NumIntSteps = 200
    x, y = planes_of(at.find_m66(ring.disable_6d(copy=True), orbit=np.zeros(6))[0])
    np.testing.assert_allclose(ours.x, x, atol=1e-6)
    np.testing.assert_allclose(ours.y, y, atol=1e-6)


def test_the_three_dialects_say_the_same(written):
    r = [
        load_lattice(written(n, t), energy=135.0).upto(last).matrix().planes
        for (n, t), last in zip(FILES.items(), ("OTR", "OTR", "BPM.drift"), strict=True)
    ]
    np.testing.assert_allclose(r[0], r[1], atol=1e-12)
    np.testing.assert_allclose(r[0], r[2], atol=1e-12)


BENDS = {
    "sbend": "b: sbend, l=0.5, angle=0.3, e1=0.1, e2=0.05, k1=0.7;",
    "negative": "b: sbend, l=0.5, angle=-0.3, e1=0.1, e2=0.05, k1=0.7;",
    "rbend": "b: rbend, l=0.5, angle=0.3, e1=0.02, e2=0.05;",
    "negative rbend": "b: rbend, l=0.5, angle=-0.3, e1=0.02, e2=0.05;",
    "vertical": "b: sbend, l=0.5, angle=0.3, e1=0.1, e2=0.05, k1=0.7, tilt=pi/2;",
    "the other vertical": "b: sbend, l=0.5, angle=0.3, e1=0.1, e2=0.05, k1=0.7, tilt=-pi/2;",
    "upside down": "b: sbend, l=0.5, angle=0.3, e1=0.1, e2=0.05, k1=0.7, tilt=pi;",
    "off": "b: sbend, l=0.5, angle=0, e1=0.1, k1=0.7;",
    "turned quadrupole": "b: quadrupole, l=0.5, k1=1.3, tilt=pi/2;",
    "thin": "b: multipole, knl={0, 1.3, 4};",
    "sextupole": "b: sextupole, l=0.5, k2=5;",
}


@pytest.mark.parametrize("bend", BENDS)
def test_matrix_is_that_of_madx(bend, written):
    cpymad = pytest.importorskip("cpymad.madx", reason="cpymad is not installed")
    text = f"""beam, particle=electron, energy=135;
    q: quadrupole, l=0.12, k1=2.1;
    {BENDS[bend]}
    s: monitor;
    lc: sequence, l=3, refer=centre; q, at=0.2; b, at=1; s, at=3; endsequence;
    """
    ours = load_lattice(written("line.madx", text)).matrix()
    madx = cpymad.Madx(stdout=False)
    madx.input(text)
    madx.use(sequence="lc")
    twiss = madx.twiss(sequence="lc", betx=1, bety=1, rmatrix=True)
    m66 = [[twiss[f"re{i}{j}"][-1] for j in (1, 2, 3, 4, 6)] for i in (1, 2, 3, 4, 6)]
    x, y = planes_of(np.array(m66))
    # MAD-X's p_t is δ·β; at 135 GeV β = 1 to 7e-12.
    np.testing.assert_allclose(ours.x, x, atol=1e-9)
    np.testing.assert_allclose(ours.y, y, atol=1e-9)
    madx.quit()


def test_what_a_scan_needs_is_told_without_building(written):
    file = read_lattice(written("line.madx", MADX))
    assert file.calibrations == {"Q1": "k1"}
    assert file.places == ["BPM", "OTR"]
    assert file.default_screen == "OTR"
    assert (file.energy, file.particle) == (pytest.approx(135.0), "electron")
    assert next(e for e in file.elements if e["name"] == "Q1")["k1_per_m2"] == 3.7
    # halves of the monitor before and after its centre, where the size is measured
    assert build_line(file).upto("BPM").length == pytest.approx(2.0)
    line = read_lattice(written("line.lte", ELEGANT), energy=135.0)
    assert line.places == ["W1", "BPM"]
    assert build_line(line).upto("BPM").length == pytest.approx(0.12 + 0.68 + 0.4 + 1.77 + 0.03)


def test_a_marker_can_be_the_screen(written):
    path = written("a.lte", "Q: QUAD, L=0.1, K1=1\nM: MARK\nLC: LINE=(Q,M)")
    file = read_lattice(path, energy=50.0)
    assert file.default_screen is None
    assert file.places == ["M"]


def test_repeated_monitors_are_numbered_and_quadrupoles_are_in_series(written):
    text = "Q: QUAD, L=0.1, K1=1\nM: MONI\nC: LINE=(Q,M)\nLC: LINE=(2*C)"
    file = read_lattice(written("a.lte", text), use="lc", energy=50.0)
    assert [e["name"] for e in file.elements] == ["Q", "M#1", "Q", "M#2"]
    assert file.calibrations == {"Q": "k1"}


@pytest.mark.parametrize(
    ("beam", "energy"),
    [
        ("energy=0.135", 135.0),
        ("pc=0.135", np.hypot(135.0, 0.51099895)),
        ("gamma=200", 200 * 0.51099895),
        ("particle=proton, energy=1.2", 1200.0),
    ],
)
def test_energy_of_the_beam(beam, energy, written):
    text = MADX.replace("particle=electron, energy=0.135", beam)
    path = written("a.madx", text)
    assert read_lattice(path).energy == pytest.approx(energy, rel=1e-6)
    assert read_lattice(path, energy=2000.0).energy == 2000.0


def test_the_beam_of_the_sequence_counts(written):
    path = written("a.madx", MADX + "beam, sequence=lc, particle=positron, energy=0.2;\n")
    assert read_lattice(path).energy == pytest.approx(200.0)
    assert read_lattice(path).particle == "positron"


def test_nothing_is_printed(written, capfd):
    for name, text in FILES.items():
        read_lattice(written(name, text), energy=135.0)
        refused(written("bad_" + name, text.replace("L=0.12", "L=0.1*").replace("l=0.12", "l=*")))
    assert capfd.readouterr() == ("", "")


ELEMENTS = {
    "solenoid": ("e: solenoid, l=0.2, ks=0.1;", "'e' of type 'SOLENOID'"),
    "skew by k1s": ("e: quadrupole, l=0.2, k1=1, k1s=0.3;", "'e' of type 'QUADRUPOLE'"),
    "skew by tilt": ("e: quadrupole, l=0.2, k1=1, tilt=pi/4;", "tilted by 45 degrees"),
    "tilt without value": ("e: quadrupole, l=0.2, k1=1, tilt;", "'tilt' without a value"),
    "thin dipole": ("e: multipole, knl={0.1};", "'e' of type 'MULTIPOLE'"),
    "thin skew": ("e: multipole, knl={0, 0.1}, ksl={0, 0.1};", "'e' of type 'MULTIPOLE'"),
    "cavity": ("e: rfcavity, l=0.2, volt=10, freq=2856;", "VOLT = 10"),
    "fringe": ("e: sbend, l=0.2, angle=0.1, hgap=0.01, fint=0.5;", "fringe field"),
    "field": ("e: sbend, l=0.2, angle=0.1, k0=0.7;", "K0 = 0.7"),
    "quadrupole error": ("e: sextupole, l=0.2, knl={0, 0.1};", "'e' of type 'SEXTUPOLE'"),
    "no length": ("e: quadrupole, l=0, k1=3;", "length 0 m"),
    "unknown type": ("w: wiggler, l=0.2;", "'w' of type 'WIGGLER'"),
    "undefined": ("w: quadrupole, l=0.2, k1=kx;", "undefined 'kx'"),
    "no such length": ("e: sbend, angle=0.2;", "'l'"),
}


@pytest.mark.parametrize("case", ELEMENTS)
def test_focusing_that_is_not_modelled_is_refused_by_name(case, written):
    line, said = ELEMENTS[case]
    text = f"beam, energy=0.1;\n\n{line}\nd: drift, l=1;\nlc: line=(d, {line[0]}, d);\n"
    path = written("a.madx", text)
    message = refused(path)
    assert said in message
    assert str(path) in message
    if case != "no such length":
        assert message.startswith(f"{path}:3:")


@pytest.mark.parametrize(
    ("element", "said"),
    [
        ("E: SOLENOID, L=0.2, KS=0.1", "SOLENOID"),
        ("E: RFCA, L=0.2, VOLT=1e6, FREQ=2856e6", "VOLT"),
        ("E: KQUSE, L=0.2, K1=1, K2=3", "quadrupole component"),
        ("E: MULT, L=0.2, KNL=0.3, ORDER=1", "multipole components"),
        ("E: QUAD, L=0.2, K1=1, FSE=0.01", "FSE"),
        ("E: SBEN, L=0.2, ANGLE=0.1, HGAP=0.01", "fringe field"),
        ("E: CSBEND, L=0.2, ANGLE=0.1, EDGE1_EFFECTS=0", "EDGE1_EFFECTS"),
        ("E: RBEN, L=0.2, ANGLE=0.1", "RBEN"),
        ("E: EMATRIX, L=0.2", "EMATRIX"),
    ],
)
def test_elegant_elements_that_are_refused(element, said, written):
    path = written("a.lte", f"{element}\nLC: LINE=(E)\n")
    message = refused(path, energy=100.0)
    assert message.startswith(f"{path}:1:")
    assert said in message


def test_elements_without_strength_are_drifts(written):
    text = """beam, energy=0.1;
    a: solenoid, l=0.2; b: rfcavity, l=0.3; c: kicker, l=0.1, hkick=1e-4; d: octupole, l=0.5, k3=7;
    f: rcollimator, l=0.2; g: multipole; h: vkicker;
    lc: line=(a, b, c, d, f, g, h);
    """
    file = read_lattice(written("a.madx", text))
    assert {e["type"] for e in file.elements} == {"drift", "marker"}
    assert build_line(file).length == pytest.approx(1.3)


def test_which_line(written):
    text = ELEGANT + "RING: LINE=(LC,LC)\n"
    path = written("a.lte", text)
    message = refused(path, energy=100.0)
    assert "LC, RING" in message
    assert "--use" in message
    assert "did you mean RING?" in refused(path, energy=100.0, use="RNIG")
    assert read_lattice(path, energy=100.0, use="ring").name == "RING"


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.madx", MADX.replace("beam, particle=electron, energy=0.135;", ""), "--energy"),
        ("a.lte", ELEGANT, "--energy"),
        ("a.madx", MADX.replace("energy=0.135", "energy=135e6"), "GeV"),
        ("a.madx", MADX.replace("electron", "muon"), "particle 'muon'"),
        ("a.madx", "x = 3;\n", "no LINE"),
        ("a.madx", "beam, energy=1; lc: line=(lc);", "lc"),
        ("a.lte", "C: CHARGE, TOTAL=1e-9\nLC: LINE=(C)", "without elements"),
        ("a.madx", "beam, energy=1; d: drift, l=1; lc: line=(d, pi);", "'pi' in a LINE"),
        ("a.madx", "beam, energy=1; k := 3**; lc: line=(k);", "'3**'"),
        ("a.madx", "beam, energy=k; k := 3; d: drift, l=1; lc: line=(d);", "undefined 'k'"),
        ("a.madx", MADX.replace("at=0.5", "at=0.1"), "overlap"),
        ("a.madx", "call, file='nowhere.madx';\n", "nowhere.madx"),
        ("a.ele", "&run_setup\n lattice = line.lte\n&end\n", "command file"),
        ("a.madx", "beam, energy=1;\nx := ().__class__;\n", "a.madx:2"),
        ("a.madx", "x = ()->_＿class__;\n", "a.madx:1"),
        ("a.madx", "", "empty"),
    ],
)
def test_files_that_cannot_be_used(name, text, said, written):
    message = refused(written(name, text), energy=9.0 if "CHARGE" in text else None)
    assert said in message
    assert name in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("name", "old", "new", "line"),
    [
        ("line.madx", "l=0.12,", "l=0.12*,", 4),
        ("line.mad8", "L=0.68", "L=0.68)(", 7),
        ("line.lte", "L=0.68", "L=0.68+", 4),
        ("line.lte", "W1,BPM)", "W1,BPM}", 10),
    ],
)
def test_a_statement_that_does_not_parse_is_located(name, old, new, line, written):
    path = written(name, FILES[name].replace(old, new))
    assert refused(path, energy=135.0).startswith(f"{path}:{line}:")


def test_called_files_are_found_beside_the_file(written):
    written("optics.madx", MADX)
    assert read_lattice(written("main.madx", 'call, file="optics.madx";')).name == "LC"


def test_without_pyat(written, monkeypatch):
    monkeypatch.setitem(sys.modules, "at", None)
    for name, text in FILES.items():
        assert read_lattice(written(name, text), energy=135.0).name == "LC"


@given(
    st.sampled_from(sorted(FILES)),
    st.integers(0, 500),
    st.integers(0, 20),
    st.text(alphabet="(){}[],;:=!\"'&*/%+- \n.qLéé", max_size=6),
)
def test_any_damage_is_read_or_refused(tmp_path_factory, name, start, length, damage):
    text = FILES[name]
    path = tmp_path_factory.getbasetemp() / f"damaged_{name}"
    path.write_text(text[:start] + damage + text[start + length :])
    try:
        read_lattice(path, energy=135.0)
    except InputError as error:
        said = str(error)
    else:
        return
    assert str(path) in said
    assert "\n" not in said


REFERENCES = ["refer=centre", "REFER=CENTER", "refer=Entry", "REFER = EXIT", 'refer="center"', ""]


@pytest.mark.parametrize("refer", REFERENCES)
def test_every_way_of_counting_places_is_that_of_madx(refer, written):
    cpymad = pytest.importorskip("cpymad.madx", reason="cpymad is not installed")
    text = MADX.replace("refer=centre", refer).replace("l=3.0, ;", "l=3.0;")
    if "entry" in refer.lower() or "exit" in refer.lower():
        text = text.replace("at=0.06", "at=0.3").replace("at=2.0", "at=2.1")
    ours = load_lattice(written("line.madx", text)).upto("OTR").matrix()
    with cpymad.Madx(stdout=False) as madx:
        madx.input(text + "use, sequence=LC; select, flag=twiss, clear;")
        table = madx.twiss(sequence="LC", betx=1, bety=1, rmatrix=True).dframe()
    row = table[table.name.str.startswith("otr")].iloc[-1]
    for plane, (i, j) in (("x", (1, 2)), ("y", (3, 4))):
        theirs = [[row[f"re{a}{b}"] for b in (i, j)] for a in (i, j)]
        np.testing.assert_allclose(getattr(ours, plane)[:2, :2], theirs, atol=1e-9)


@pytest.mark.parametrize(
    "element",
    [
        "hkicker, l=0.1, kick:=nobody.sets.it",
        "kicker, hkick:=ch1, vkick:=cv1*2",
        "vkicker, l=0.1, kick=1e-4",
        "tkicker, l=0.1",
        "sextupole, l=0.1, k2:=ks1",
        "srotation, angle=0",
        "translation, dx=0",
        "twcavity, l=0.1, volt=0",
        "dipedge, h=0, e1=0.1",
    ],
)
def test_what_is_nothing_to_a_linear_line_is_its_length(element, written):
    text = MADX.replace("hkicker, l=0.1, kick=0", element)
    found = load_lattice(written("line.madx", text)).upto("OTR").matrix()
    expected = load_lattice(written("whole.madx", MADX)).upto("OTR").matrix()
    np.testing.assert_allclose(found.planes, expected.planes, atol=1e-12)


@pytest.mark.parametrize(
    ("element", "word"),
    [
        ("srotation, angle=0.1", "ANGLE"),
        ("translation, dx=1e-3", "DX"),
        ("dipedge, h=0.2, e1=0.1", "H = 0.2"),
        ("twcavity, l=0.1, volt=1", "VOLT"),
        ("quadrupole, l=0.1, k1:=nobody.sets.it", "nobody"),
    ],
)
def test_what_is_something_is_still_refused(element, word, written):
    text = MADX.replace("hkicker, l=0.1, kick=0", element)
    said = refused(written("line.madx", text))
    assert word.lower() in said.lower()


def test_a_part_of_a_line_with_a_marker_for_a_screen(written):
    text = MADX.replace("LC: sequence", "M1: marker;\nLC: sequence").replace(
        "BPM, at=2.0", "M1, at=1.5;\nBPM, at=2.0"
    )
    path = written("line.madx", text)
    whole = load_lattice(path)
    assert whole.screens == ("BPM", "OTR")
    part = load_lattice(path, first="B1", last="BPM", screen="M1")
    assert part.screens == ("M1",)
    expected = (
        whole.between("drift_1", "M1") if "drift_1" in [e.name for e in whole.elements] else 0
    )
    np.testing.assert_allclose(part.upto("M1").matrix().planes, expected.matrix().planes)
    for options, words in (
        ({"first": "B2"}, "--from B2"),
        ({"last": "BPM1"}, "did you mean BPM"),
        ({"first": "OTR", "last": "Q1"}, "before --from OTR"),
        ({"screen": "Q1"}, "a screen or marker"),
        ({"screen": "OTR", "last": "BPM"}, "cut away"),
    ):
        assert words in refused(path, **options)


DOUBLED = "".join(f"L{k + 1}: line=(L{k},L{k});" for k in range(60))
HOSTILE = {
    "powers": ("a = 9^9^9^9; Q2: quadrupole, l=0.1, k1=a; LC: line=(Q2,B);", "out of range"),
    "powers that wait": ("a := 9^9^9^9; Q2: quadrupole, l=0.1, k1=a; LC: line=(Q2,B);", "of range"),
    "copies": ("LC: line=(1000000000*Q1,B);", "more than 50000 elements"),
    "lines that double": (f"L0: line=(Q1);{DOUBLED}LC: line=(L60,B);", "more than 50000 elements"),
    "a list for a number": ("a = (1,2);" + "a = a + a;" * 60, "',' where it cannot stand"),
    "parentheses": (f"a = {'(1+' * 5000}1{')' * 5000};Q1->k1=a;LC: line=(Q1,B);", "recursion"),
    "lists in lists": (f"LC: line={'(' * 5000}Q1{')' * 5000};", "lists within lists"),
    "a number of copies": (f"LC: line=({'9' * 5000}*Q1,B);", "more than 50000 elements"),
    "names in a ring": ("a := b; b := a; Q1->k1 = a; LC: line=(Q1,B);", "defined by itself"),
    "comments": ("/*\n" * 100_000 + "LC: line=(Q1,B);", "no LINE"),
    "a file that calls itself": ('call, file="a.madx";', "more than 50 files called"),
    "a device": ('call, file="/dev/zero";', "a device"),
}
BASIS = "beam, energy=0.135; Q1: quadrupole, l=0.1, k1=1; B: monitor;\n"


@pytest.mark.parametrize("case", HOSTILE)
def test_what_stands_for_something_without_end(case, written):
    text, said = HOSTILE[case]
    assert said in refused(written("a.madx", f"{BASIS}{text}"), use="LC")


def test_products_that_double_their_digits_are_no_whole_numbers(written):
    text = f"{BASIS}a = 2^60;{'a = a*a;' * 60}LC: line=(Q1,B);"
    assert len(read_lattice(written("a.madx", text)).elements) == 2


def test_a_power_is_a_power_however_it_is_assigned(written):
    """pyAT takes ^ after := for the exclusive or of bits: 2^3 was 1."""
    read = [read_lattice(written("a.madx", MADX.replace("kq := 3.7", f"kq {sign} 2^3")))
            for sign in ("=", ":=")]  # fmt: skip
    assert read[0].elements == read[1].elements
    assert 8.0 in read[1].elements[0].values()


DIALECTS = {
    "words cut, a part of an element, late": (
        "a.mad8",
        "Q1: QUADRU, L=0.1, K1=K*Q2[K1]\nQ2: QUAD, L=0.1, K1=K\nK = 1\nSET, K, 2\n"
        "BEAM, ENERGY=0.1\nM: MONI\nTITLE\n it's (a scan\nLC: LINE=(Q1,Q2,M)\nUSE, LC\n",
        [4.0, 2.0],
    ),
    "derived, two statements on a line": (
        "a.mad8",
        "BEAM, PC=0.1; Q: QUAD, L=0.1, K1=3 ! one\nR: Q, K1=-1; LC: LINE=(Q,R)\nRETURN\n(",
        [3.0, -1.0],
    ),
    "calculator": (
        "a.lte",
        "% 2 sto a\n% a 3 swap - sto b ! 1\nQ1: QUAD, L=0.1, K1=\"a 2 pow b + sqrt\"\n"
        "Q2: KQUAD, L=0.1, &\n K1=\"90 dsin chs\", GROUP=\"a b\"\nLC: LINE=(Q1,Q2)\n",
        [5**0.5, -1.0],
    ),
    "names in quotes": (
        "a.lte",
        '"QUAD:IN20-1": QUAD, L=0.1, K1=3\nM: MARK\n"L-1": LINE=("QUAD:IN20-1",M)\n'
        'LC: LINE=("L-1",-"L-1")\n',
        [3.0, 3.0],
    ),
    "what has no length and no field": (
        "a.lte",
        "C: CHARGE, TOTAL=1e-9\nE: MALIGN\nQ: QUAD, L=0.1, K1=3\nH: HKICK, L=0.1\n"
        "S: KSEXT, L=0.1, K2=3\nT: MULT, KNL=3, ORDER=2\nLC: LINE=(C,Q,E,H,S,T)\n",
        [3.0],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", DIALECTS)
def test_what_other_programs_write(case, written):
    name, text, k1 = DIALECTS[case]
    file = read_lattice(written(name, text), use="LC", energy=100.0)
    assert [e["k1_per_m2"] for e in file.elements if e["type"] == "quadrupole"] == pytest.approx(k1)


def test_names_of_elegant_are_shown_as_they_are(written):
    path = written("a.lte", DIALECTS["names in quotes"][1])
    file = read_lattice(path, use="l-1", energy=100.0)
    assert file.name == "L-1"
    assert file.calibrations == {"QUAD:IN20-1": "k1"}


def test_thin_quadrupoles(written):
    for name, text in (
        ("a.mad8", "BEAM, ENERGY=0.1\nT: MULT, K1L=0.3, K2L=4\nLC: LINE=(T)\n"),
        ("a.lte", "T: MULT, KNL=0.3\nLC: LINE=(T)\n"),
    ):
        [lens] = read_lattice(written(name, text), energy=100.0).elements
        assert (lens["type"], lens["k1l_per_m"]) == ("thin_lens", 0.3)


def test_included_files_of_elegant(written):
    written("optics.lte", ELEGANT)
    assert read_lattice(written("a.lte", '#INCLUDE: "optics.lte"\n'), energy=9.0).name == "LC"


@pytest.mark.parametrize(
    ("name", "text", "line", "said"),
    [
        ("a.mad8", "BEAM, ENERGY=1\n\nT: MULT, K1L=1, T1\nLC: LINE=(T)\n", 3, "T1 ="),
        ("a.mad8", "BEAM, ENERGY=1\nQ: QUAD, L=1, KL=1\nLC: LINE=(Q)\n", 2, "'kl' of element 'Q'"),
        ("a.mad8", "BEAM, ENERGY=1\nW: LCAV, L=1\nLC: LINE=(W)\n", 2, "type 'LCAV'"),
        ("a.lte", 'Q: QUAD, L=1, K1="1 2"\nLC: LINE=(Q)\n', 1, "'\"1 2\"'"),
        ("a.lte", "% 1 2 atan2 sto k\nLC: LINE=(Q)\n", 1, "'%'"),
        ("a.lte", "M: MULT, KNL=1, ORDER=0\nLC: LINE=(M)\n", 1, "dipole or skew component"),
        ("a.lte", "S: KSEXT, L=1, K1=1\nLC: LINE=(S)\n", 1, "quadrupole component"),
    ],
)
def test_what_other_programs_write_and_is_refused(name, text, line, said, written):
    path = written(name, text)
    message = refused(path, energy=1000.0)
    assert message.startswith(f"{path}:{line}:")
    assert said in message


@pytest.mark.filterwarnings("ignore::at.AtWarning")
@pytest.mark.parametrize("name", ["a.mad8", "a.lte"])
def test_a_reflected_bend_has_its_faces_the_other_way_round(name, written):
    """As in pyAT, elegant and MAD-8, not as in MAD-X (tests/io/test_madx.py)."""
    text = "B: SBEND, L=0.4, ANGLE=0.3, E1=0.2, E2=-0.05\nLC: LINE=(B,-B)\n"
    text = "BEAM, ENERGY=135\n" * name.endswith("mad8") + text
    path = written(name, text)
    bends = read_lattice(path, energy=135e3).elements
    assert [b["entrance_edge_deg"] for b in bends] == pytest.approx(np.degrees([0.2, -0.05]))
    ring = LOADERS["line." + name[2:]](path, use="LC", energy=135e9)
    assert [b.EntranceAngle for b in ring] == pytest.approx([0.2, -0.05])


PARTS = {
    "QUAD": "K1={k:.5f}", "SBEN": "ANGLE={a:.5f}, E1={b:.4f}, E2={c:.4f}", "SEXT": "K2=3",
    "DRIF": "", "MONI": "", "HKICK": "",
}  # fmt: skip
FULL |= {"SEXT,": "SEXTUPOLE,", "MONI,": "MONITOR,", "HKICK,": "HKICKER,"}


def any_line(number):
    """A line of elements at random, written for MAD-8 and elegant."""
    rng = np.random.default_rng(number)
    kinds = rng.choice([*PARTS], rng.integers(2, 7))
    text = ""
    for i, kind in enumerate(kinds):
        k, a, b, c, length = rng.uniform(-1, 1, 5)
        more = PARTS[kind].format(k=5 * k, a=0.1 + 0.3 * abs(a), b=0.2 * b, c=0.2 * c)
        text += f"E{i}: {kind}, {', '.join(filter(None, [f'L={0.3 + 0.2 * length:.4f}', more]))}\n"
    names = [f"E{i}" for i in range(len(kinds))]
    part = rng.permutation(names)[:2]
    return f"{text}SUB: LINE=({','.join(part)})\nLC: LINE=({','.join(names)},-SUB,2*E0)\n"


@simulations(10, 40)
@pytest.mark.filterwarnings("ignore::at.AtWarning")
@pytest.mark.parametrize("name", ["a.mad8", "a.lte"])
def test_lines_at_random_are_those_of_pyat(name, written, count):
    for number in range(count):
        text = any_line(number)
        if name == "a.mad8":
            text = f"BEAM, PARTICLE=ELECTRON, ENERGY=135\n{text}"
        ours = load_lattice(written(name, text), use="LC", energy=135e3).matrix()
        for short, full in FULL.items():
            text = text.replace(short, full)
        ring = LOADERS["line." + name[2:]](written("peer_" + name, text), use="LC", energy=135e9)
        for element in ring:
            if hasattr(element, "NumIntSteps"):
                element.NumIntSteps = 100
        m66 = at.find_m66(ring.disable_6d(copy=True), orbit=np.zeros(6))[0]
        for plane, theirs in zip((ours.x, ours.y), planes_of(m66), strict=True):
            np.testing.assert_allclose(plane[:2, :2], theirs[:2, :2], rtol=1e-5, atol=1e-5)
