"""docs/equations.md names what there is: every equation of the report, function, file and test."""

import re
from importlib import import_module


def found(name):
    """What a dotted name of the package means: a module's own, or a method of it."""
    module, *rest = name.split(".")
    thing = import_module(module)
    for part in rest:
        module = f"{module}.{part}"
        thing = getattr(thing, part) if hasattr(thing, part) else import_module(module)
    return thing


def test_every_equation_has_a_function_and_a_test(root):
    text = (root / "docs/equations.md").read_text()
    names = re.findall(r"`(beamfit\.[\w.]+)`", text)
    assert len(names) > 25
    assert all(callable(found(n)) or type(found(n)).__module__.startswith("beamfit") for n in names)
    files = [f"tests/{name}.py" for name in re.findall(r"\w+/test_\w+", text)]
    assert len(files) > 25
    for row in re.findall(r"^\| \d.*", text, re.MULTILINE):
        name, test = (re.search(form, row) for form in (r"`beamfit\.([\w.]+)`", r"\w+/test_\w+"))
        if name and test:
            calls = (root / f"tests/{test[0]}.py").read_text()
            assert re.search(rf"\b{name[1].rpartition('.')[2]}\b", calls), row
    files += re.findall(r"(?:benchmarks|measurements)/\w+\.py", text)
    assert [f for f in files if not (root / f).is_file()] == []
    numbers = set()
    for said in re.findall(r"^\| (\d[^|]*)", text, re.MULTILINE):
        for first, last in re.findall(r"(\d+)(?:-(\d+))?", said):
            numbers |= set(range(int(first), int(last or first) + 1))
    assert numbers == set(range(1, 47))
