"""The source distribution holds what the README uses."""

import re
import subprocess
import sys
import tarfile


def test_every_file_that_the_readme_uses_is_in_the_sdist(root, tmp_path):
    build = "import sys; from hatchling.build import build_sdist; build_sdist(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, tmp_path], cwd=root, check=True)
    (archive,) = tmp_path.glob("beamfit-*.tar.gz")
    with tarfile.open(archive) as tar:
        held = {name.partition("/")[2] for name in tar.getnames()}
    readme = (root / "README.md").read_text()
    folders = "measurements|lattices|formulations|benchmarks|docs"
    used = set(re.findall(rf"(?:{folders})/[\w./]*\w", readme))
    used |= {"Makefile", "constraints.txt", "LICENSE", "CITATION.cff", "CONTRIBUTING.md"}
    assert len(used) > 20
    missing = [u for u in used if u not in held and not any(h.startswith(f"{u}/") for h in held)]
    assert missing == []
    assert archive.stat().st_size < 20e6
    assert not [name for name in held if name.startswith((".venv", "build/", "demo/"))]
