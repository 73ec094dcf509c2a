"""MAD-X files of one feature each: read as MAD-X reads them, or refused with the line."""

import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io.line import load_lattice, read_lattice
from beamfit.particles import REST_ENERGY
from tests.simulations import simulations

# In every text @ begins the names, so that one MAD-X reads all files, and {0}, {1}, ... are
# numbers between -1 and 1. Elements: quadrupoles q1 and q2, drift d, marker m, monitor b.
ELEMENTS = """@k = 2 + {0};
@q1: quadrupole, l=0.1, k1=1+{1}; @q2: quadrupole, l=0.2, k1=3*{2};
@d: drift, l=0.3; @m: marker; @b: monitor, l=0.06;
"""
SEQUENCE = "@lc: sequence, l=3; @q1, at=0.5; @q2, at=1.5; @b, at=2.5; endsequence;\n"
READ = {
    "arrow": SEQUENCE + "@q1->k1 = {3};",
    "arrow before": "@q1->k1 = {3};" + SEQUENCE,
    "arrow of an expression": SEQUENCE + "@q1->k1 = 2*@k - @q2->k1;",
    "arrow := is at once": SEQUENCE + "@q1->k1 := @k; @k = {3};",
    "arrow of a length": SEQUENCE + "@q2->l = 0.4 + 0.1*{3};",
    "arrow leaves the derived": "@q3: @q1; @q1->k1 = {3};" + SEQUENCE.replace("@q2", "@q3"),
    "derived after": "@q1->k1 = {3}; @q3: @q1;" + SEQUENCE.replace("@q2", "@q3"),
    "derived with more": "@q3: @q1, k1 = {3};" + SEQUENCE.replace("@q2", "@q3"),
    "changed by its name": SEQUENCE + "@q1, k1 = {3}, l = 0.15;",
    "deferred": "@q1, k1 := @k*@j;" + SEQUENCE + "@j = {3}; @k = 1.5;",
    "not deferred": "@j = 2; @q1, k1 = @k*@j;" + SEQUENCE + "@j = {3}; @k = 1.5;",
    "chain of deferred": "@a := @c*2; @c := @j + 1; @q1, k1 := @a;" + SEQUENCE + "@j = {3};",
    "defined again": SEQUENCE + "@q1: quadrupole, l=0.1, k1 = {3};",
    "from": "@lc: sequence, l=3; @q1, at=0.5+0.1*{3}; @q2, at=1, from=@q1; @b, at=2.5; "
    "endsequence;",
    "chained from": "@lc: sequence, l=3; @q1, at=0.5; @q2, at=0.6+0.1*{3}, from=@q1;"
    "@b, at=0.5, from=@q2; endsequence;",
    "chained from by entry": "@lc: sequence, l=3, refer=entry; @q1, at=0.5; @q2, at=0.6, from=@q1;"
    "@b, at=0.5+0.1*{3}, from=@q2; endsequence;",
    "chained from by exit": "@lc: sequence, l=3, refer=exit; @q1, at=0.5; @q2, at=0.6, from=@q1;"
    "@b, at=0.5+0.1*{3}, from=@q2; endsequence;",
    "from what follows": "@lc: sequence, l=3; @q1, at=-1+0.1*{3}, from=@q2; @q2, at=1.5; "
    "endsequence;",
    "place deferred": "@lc: sequence, l=3; @q1, at:=@j; @q2, at:=@j+0.7; endsequence; "
    "@j = 0.6+0.1*{3};",
    "length deferred": "@lc: sequence, l:=@j; @q1, at=0.5; endsequence; @j = 2.6+0.1*{3};",
    "defined in its place": "@lc: sequence, l=3; @q3: quadrupole, l=0.1, k1={3}, at=1; "
    "endsequence;",
    "entry": SEQUENCE.replace("l=3", "l=3, refer=entry"),
    "exit": SEQUENCE.replace("l=3", "l=3, refer=EXIT"),
    "sequence in a sequence": "@s: sequence, l=0.5; @q1, at=0.2+0.1*{3}; endsequence;"
    "@lc: sequence, l=3, refer=entry; @s, at=0.5; @q2, at=1.2; @s, at=2; endsequence;",
    "sequence by its exit": "@s: sequence, l=0.5, refer=entry; @q1, at=0.2+0.1*{3}; endsequence;"
    "@lc: sequence, l=3, refer=exit; @s, at=0.7; @q2, at=1.2; endsequence;",
    "refpos": "@s: sequence, l=0.5, refpos=@q1; @q1, at=0.2+0.1*{3}; endsequence;"
    "@lc: sequence, l=3; @s, at=0.7; @q2, at=2; endsequence;",
    "refpos by entry": "@s: sequence, l=0.5, refer=entry, refpos=@q1; @q1, at=0.2+0.1*{3}; "
    "endsequence;"
    "@lc: sequence, l=3, refer=exit; @s, at=0.7; @q2, at=2; endsequence;",
    "from a sequence": "@s: sequence, l=0.5; @q1, at=0.2; endsequence;"
    "@lc: sequence, l=3; @s, at=0.7; @q2, at=1+0.1*{3}, from=@s; endsequence;",
    "line": "@lc: line = (@q1, @d, 2*(@q2, @d), @b);",
    "line of lines": "@c: line = (@q1, @d, @m); @lc: line = (@c, @q2, 2*@c);",
    "reversed line": "@c: line = (@q1, @d, @m); @lc: line = (@c, @q2, -@c);",
    "reversed list": "@lc: line = (@q2, @d, -(@q1, @d, 2*@q2, @m, @d));",
    "reversed within reversed": "@c: line = (@q1, @d, @q2); @lc: line = (-(@q2, -@c, @d), @d);",
    "negative repetition": "@c: line = (@q1, @d, @m); @lc: line = (@d, @q2, -2*@c);",
    "repetition of a reversed list": "@c: line = (@q1, @d); @lc: line = (@q2, 3*(-@c));",
    "reversed bend": "@e: sbend, l=0.4, angle=0.3*{3}, e1=0.1, e2=-0.05;"
    "@c: line = (@e, @d, @q1); @lc: line = (@q2, -@c);",
    "rbend": "@e: rbend, l=0.4, angle=0.5*{3}, e1=0.1*{4}, k1={5}; @lc: line = (@q1, @d, @e, @q2);",
    "rbend off": "option, rbarc=false; @e: rbend, l=0.4, angle=0.5*{3}; @lc: line = (@q1, @d, @e);",
    "rbend off later": "@e: rbend, l=0.4, angle=0.5*{3}; @lc: line = (@q1, @d, @e); "
    "option, -rbarc;",
    "rbend in a sequence": "@e: rbend, l=0.4, angle=0.5+0.2*{3}; @lc: sequence, l=3, refer=entry;"
    "@q1, at=0.5; @e, at=1; @q2, at=2; endsequence;",
    "sbend": "@e: sbend, l=0.4, angle=0.5*{3}, e1=0.1*{4}, e2=0.1*{5}, k1={0};"
    "@lc: line = (@q1, @d, @e, @q2);",
    "vertical sbend": "@e: sbend, l=0.4, angle=0.5*{3}, e1=0.1*{4}, tilt=pi/2;"
    "@lc: line = (@q1, @d, @e, @q2);",
    "turned": "@e: quadrupole, l=0.2, k1={3}, tilt=-pi/2; @lc: line = (@q1, @d, @e, @q2);",
    "thin": "@e: multipole, knl:={{0, @j, 3}}; @j = {3}; @lc: line = (@q1, @d, @e, @d, @q2);",
    "if": "if (@k > 2) {{@q1->k1 = {3};}}" + SEQUENCE,
    "if else": "if (@k*2 > 4 && {3} < 0.5) {{@j = 1;}} else {{@j = -2;}} @q1, k1 = @j;" + SEQUENCE,
    "elseif": "if (@k > 2.5) {{@j = 1;}} elseif (@k > 2 || @k < 1.5) {{@j = {3};}}"
    "else {{@j = -2;}} @q1->k1 = @j;" + SEQUENCE,
    "if in if": "if (@k > 1.5) {{if (@k > 2) {{@q1->k1 = {3};}} else {{@q2->k1 = {3};}}}}"
    + SEQUENCE,
    "if in a sequence": "@lc: sequence, l=3; @q1, at=0.5; "
    "if (@k > 2) {{@q2, at=1.5;}} endsequence;",
    "expressions": "@q1, k1 = -@k^2/3 + sqrt(abs({3}))*sin(@k) - 2^0.5^2 + 1.5e-1 + .5;" + SEQUENCE,
    "constants": "@q1, k1 = pi*{3} + degrad/100 + clight/3e8 + pmass;" + SEQUENCE,
    "functions": "@q1, k1 = atan({3}) + sinc(@k) + floor(@k) + frac({3}) + erf({3}) + round(2.5);"
    + SEQUENCE,
    "const, real, int": "const @j = {3}; @j = 7; real @a = 2; int @c = 7/2; @q1, k1 = @j+@a+@c;"
    + SEQUENCE,
    "real const": "real const @j := {3}+@k; int const @c = 7/2; @j = 9; @k = 7; @q1, k1 := @j+@c;"
    + SEQUENCE,
    "version": "if (version > 50000) {{@q1->k1 = {3};}}" + SEQUENCE,
    "slots": SEQUENCE.replace("at=0.5", "at=0.5, slot_id=7, mech_sep=0.194, aperture={{1, 2}}"),
    "return in the file itself": SEQUENCE + "return; @q1->k1 = {3};",
    "comments": "/* @q1->k1 = 7; */ // @q1->k1 = 8;\n! @q1->k1 = 9; it's\n" + SEQUENCE,
    "capitals and blanks": "@Q1 , K1\n = {3} ;" + SEQUENCE.upper().replace("=0.5", " = 0.5"),
    "title and others": "title, 'a; b ! c'; value, @k; select, flag=twiss, column=s; "
    "set, format='8f';"
    "option, -echo, -info;" + SEQUENCE,
    "strings": '@q1, type="a, b=3; {{c}}", apertype=ellipse, aperture={{0.1, 0.2}};' + SEQUENCE,
    "kicks at zero": "@e: kicker, l=0.1, hkick:=@nobody; @lc: line = (@q1, @e, @d, @q2);",
    "sextupole": "@e: sextupole, l=0.1, k2=5*{3}; @lc: line = (@q1, @e, @d, @q2);",
    "monitors": "@e: hmonitor, l=0.1; @f: instrument, l=0.2; @lc: line = (@q1, @e, @d, @f, @q2);",
    "macro that nobody calls": "@mm(x): macro = {{@q1->k1 = x;}}" + SEQUENCE,
}
# What is left out; the statement behind ~, a new line, must be named.
REFUSED = {
    "seqedit": SEQUENCE + "~seqedit, sequence=@lc; remove, element=@q1; endedit;",
    "option": "~option, unheard;" + SEQUENCE,
    "the other way": SEQUENCE + "~beam, sequence=@lc, particle=electron, energy=0.1, bv=-1;",
    "while": "~while (@k < 9) {{@k = @k + 1;}}" + SEQUENCE,
    "exec": "@mm(x): macro = {{@q1->k1 = x;}}~exec, @mm(3);" + SEQUENCE,
    "match": SEQUENCE + "~match, sequence=@lc;",
    "zero repetition": "~@lc: line = (@q1, 0*@q2, @d);",
    "repeated reversal": "~@lc: line = (@q1, 2*-@q2, @d);",
    "formal arguments": "~@c(x): line = (x, @d); @lc: line = (@c(@q1));",
    "sequence in a line": SEQUENCE + "~@l2: line = (@lc, @q1); use, period=@l2;",
    "parameters in a place": "@lc: sequence, l=3;~@q1, at=0.5, k1={3}; endsequence;",
    "length of a sequence": SEQUENCE + "~@lc->l = 5;",
    "defaults of a class": "~quadrupole, k1=3;" + SEQUENCE,
    "two signs": "~@q1->k1 = 2*-3;" + SEQUENCE,
    "blanks around an arrow": SEQUENCE + "~@q1 -> k1 = 3;",
    "const real": "~const real @j = 2; @q1->k1 = @j;" + SEQUENCE,
    "undefined": "~@q1->k1 = @nobody;" + SEQUENCE,
    "a table": "@j = table(summ, q1);~@q1->k1 = @j;" + SEQUENCE,
    "solenoid": "~@e: solenoid, l=0.1, ks=0.3; @lc: line = (@q1, @e);",
    "skew": "~@e: quadrupole, l=0.1, k1s=0.3; @lc: line = (@q1, @e);",
    "unknown class": "~@e: wiggler, l=0.1; @lc: line = (@q1, @e);",
    "misspelled": "~@e: quadrupole, l=0.1, kl=3; @lc: line = (@q1, @e);",
    "errors": SEQUENCE + "~efcomp, order:=0, dkn={{0, 1e-4}};",
    "thin": SEQUENCE + "~use, sequence=@lc; makethin, sequence=@lc;",
    "part by use": SEQUENCE + "~use, sequence=@lc, range=@q1/@q2;",
    "overlap": "@lc: sequence, l=3; @q1, at=0.5; ~@q2, at=0.52; endsequence;",
    "beyond the end": "~@lc: sequence, l=0.4; @q1, at=0.5; endsequence;",
    "negative drift": "~@e: drift, l=-0.1; @lc: line = (@q1, @e);",
    "beam by arrow": SEQUENCE + "~beam->energy = 2;",
}


def written(tmp_path, name, number, text):
    """Write the file of a feature, with numbers and names of its own."""
    rng = np.random.default_rng(number)
    numbers = [f"({v:.6f})" for v in rng.uniform(-1, 1, 6)]
    text = (ELEMENTS + text.replace("~", "\n")).format(*numbers)
    text = f"beam, particle=electron, energy=135;\n{text}".replace("@", f"f{number}_")
    path = tmp_path / f"{name.replace(' ', '_').replace(':', '')}_{number}.madx"
    path.write_text(text)
    return path


@simulations(50, 300)
def test_no_file_is_read_otherwise_than_madx_reads_it(tmp_path, count):
    cpymad = pytest.importorskip("cpymad.madx", reason="cpymad is not installed")
    with cpymad.Madx(stdout=False) as madx:
        for number in range(count):
            name = [*READ][number % len(READ)]
            path = written(tmp_path, name, number, READ[name])
            sequence = f"f{number}_lc"
            madx.input(path.read_text())
            madx.input(f"use, sequence={sequence};")
            twiss = madx.twiss(sequence=sequence, betx=1, bety=1, rmatrix=True)
            madx.input("option, rbarc=true;")
            line = load_lattice(path, use=sequence)
            assert float(line.length) == pytest.approx(twiss["s"][-1], abs=2e-6), name
            for at, plane in ((1, "x"), (3, "y")):
                rows = (at, at + 1)
                theirs = [[twiss[f"re{i}{j}"][-1] for j in rows] for i in rows]
                ours = np.asarray(getattr(line.matrix(), plane))[:2, :2]
                np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-8, err_msg=name)


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_carried_out_is_refused_with_its_line(name, tmp_path):
    path = written(tmp_path, name, 7, REFUSED[name])
    with pytest.raises(InputError) as raised:
        read_lattice(path)
    text = ELEMENTS + REFUSED[name]
    line = 2 + text[: text.index("~")].count("\n") + 1
    assert str(raised.value).startswith(f"{path}:{line}:")
    assert "\n" not in str(raised.value)


BEAMS = [
    "particle=electron, energy=0.2",
    "particle=proton, pc=0.7",
    "particle=electron, gamma=150",
    "particle=proton, beta=0.7",
    "particle=positron, brho=0.9",
    "particle=proton, energy=2, pc=1, gamma=9",
    "particle=antiproton, energy=2",
    "energy=0.2",
    "particle=ion, mass=1.875613, charge=1, energy=3",
    "mass=pmass, charge=1, energy=3",
    "particle=electron, energy=0.2, ex=1e-9, kbunch=2, bunched",
    "particle=electron, energy=1; beam, energy=0.5",
    "particle=electron, energy=1; beam, pc=0.5",
    "particle=proton, energy=3; beam, gamma=4",
    "particle=electron, energy=1; beam, sequence=lc, particle=proton, energy=3",
    "particle=electron, energy=1; beam, sequence=other, particle=proton, energy=3",
    "particle=proton, energy=2; resbeam; beam, energy=0.3",
]
LINE = "q: quadrupole, l=0.1, k1=1; lc: sequence, l=1; q, at=0.5; endsequence;"


@pytest.mark.parametrize("beam", BEAMS)
def test_the_beam_is_that_of_madx(beam, tmp_path):
    cpymad = pytest.importorskip("cpymad.madx", reason="cpymad is not installed")
    path = tmp_path / "a.madx"
    path.write_text(f"{LINE} beam, {beam};")
    file = read_lattice(path)
    with cpymad.Madx(stdout=False) as madx:
        madx.input(path.read_text() + "use, sequence=lc;")
        theirs = madx.sequence.lc.beam
        assert file.energy == pytest.approx(1e3 * theirs["energy"], rel=1e-8)
        assert REST_ENERGY[file.particle] == pytest.approx(1e3 * theirs["mass"], rel=1e-6)


@pytest.mark.parametrize(
    ("beam", "said"),
    [
        ("particle=deuteron, energy=3", "particle 'deuteron'"),
        ("particle=proton, mass=0.5, energy=3", "mass 0.5 GeV"),
        ("particle=ion, mass=193.7, charge=82, energy=574000", "charge 82"),
        ("particle=electron, charge=2, energy=3", "charge 2"),
        ("particle=negmuon, energy=3", "'negmuon'"),
        ("particle=proton, energy=0.5", "rest energy"),
        ("particle=proton, energy:=e0", "the undefined 'e0'"),
        ("particle=proton", "--energy"),
        ("particle=proton, energy=3, bv=-1", "BV = -1"),
        ("particle=proton, beta=1.2", "between 0 and 1"),
    ],
)
def test_beams_that_are_refused(beam, said, tmp_path):
    path = tmp_path / "a.madx"
    path.write_text(f"{LINE} beam, {beam};")
    with pytest.raises(InputError, match=r"a\.madx") as raised:
        read_lattice(path)
    assert said in str(raised.value)


def test_a_called_file_may_return_and_is_named(tmp_path):
    (tmp_path / "strengths.madx").write_text("kq = 2;\nreturn;\nkq = 3;")
    main = tmp_path / "main.madx"
    main.write_text(
        f"beam, energy=1; {LINE}\ncall, file='strengths.madx';\nq->k1 = kq; stop; q->k1 = 9;"
    )
    assert read_lattice(main).elements[1]["k1_per_m2"] == 2.0
    (tmp_path / "strengths.madx").write_text("kq = 2;\nseqedit, sequence=lc;")
    with pytest.raises(InputError, match=r"strengths.madx:2: 'seqedit, sequence=lc'"):
        read_lattice(main)


def test_use_chooses_the_line(tmp_path):
    path = tmp_path / "a.madx"
    path.write_text(f"beam, energy=1; {LINE} l2: line=(q); use, period=l2;")
    assert read_lattice(path).name == "l2"
    assert read_lattice(path, use="lc").name == "lc"


def test_a_chain_of_sums_is_no_matter_of_time(tmp_path):
    path = tmp_path / "a.madx"
    sums = "".join(f"a{i} := a{i + 1} + a{i + 1};" for i in range(60))
    path.write_text(
        f"beam, energy=1; {LINE} {sums} a60 = 2^-1; q, k1 := a0;".replace("2^-1", "1e-18")
    )
    assert read_lattice(path).elements[1]["k1_per_m2"] == pytest.approx(2.0**60 * 1e-18)
