"""Scripts keep what they compiled, where the user allows it and nowhere else."""

import json
import os
import subprocess
import sys
from importlib.metadata import version

import numpy as np
import pytest
import scipy.linalg  # noqa: F401 - its library is there before threads are counted
from threadpoolctl import threadpool_info, threadpool_limits

from beamfit import compile_cache
from beamfit.__main__ import THREADS
from beamfit.commands import with_paths
from beamfit.compile_cache import TESTED_JAX, usual_arithmetic

# Says where code is kept and how often it was found there; runs one of the package's functions.
SCRIPT = """
import json, sys
import jax
{before}
found = []
jax.monitoring.register_event_listener(lambda name, **more: found.append(name))
from beamfit.optics.beam import BeamMatrix
import jax.numpy as jnp
value = jax.jit(lambda x: jnp.linalg.qr(x)[1])(jnp.eye(3))
count = lambda end: sum(name.endswith("compilation_cache/" + end) for name in found)
counts = [count("cache_hits"), count("cache_misses")]
least = jax.config.jax_persistent_cache_min_compile_time_secs
print(json.dumps([jax.config.jax_compilation_cache_dir, *counts, str(value.dtype), least]))
"""
# A command run in this process before has silenced warnings for those it starts.
CHOSEN = ("JAX_", "XLA_", "PYTHONWARNINGS")


def run(before="", warned="", **environment):
    kept = {k: v for k, v in os.environ.items() if not k.startswith(CHOSEN)}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(before=before)],
        env=kept | {"PYTHONPATH": os.pathsep.join(sys.path)} | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert warned in done.stderr
    assert bool(done.stderr) == bool(warned)
    return json.loads(done.stdout)


# Said where a private part of JAX was replaced.
WHOLE = """
from jax._src import compilation_cache as own; had = dict(vars(own)); import atexit
same = lambda: all(vars(own)[k] is v for k, v in had.items() if callable(v))
atexit.register(lambda: same() or sys.stderr.write('replaced'))
"""


def test_the_second_script_compiles_nothing_and_damaged_code_is_compiled_anew(tmp_path):
    folder, hits, misses, dtype, _ = run(WHOLE, XDG_CACHE_HOME=str(tmp_path))
    assert folder == str(tmp_path / "beamfit" / "jax")
    assert (hits, dtype) == (0, "float64")
    assert misses > 0
    assert run(XDG_CACHE_HOME=str(tmp_path))[1:3] == [misses, 0]
    for path in (tmp_path / "beamfit" / "jax").iterdir():
        content = path.read_bytes()
        # Half of a file: a single bit may stand where nothing is read, and the times in it vary.
        path.write_bytes(content[: len(content) // 2])
    said = "Error reading persistent compilation cache entry"
    assert run(warned=said, XDG_CACHE_HOME=str(tmp_path))[1:3] == [0, misses]


def test_a_folder_that_others_can_write_to_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    place = compile_cache.own_folder()
    assert place == str(tmp_path / "beamfit")
    assert (tmp_path / "beamfit").stat().st_mode & 0o777 == 0o700
    (tmp_path / "beamfit").chmod(0o777)
    with pytest.warns(UserWarning, match="is not used; chmod 700"):
        assert compile_cache.own_folder() is None
    (tmp_path / "beamfit").chmod(0o755)
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    with pytest.warns(UserWarning, match="belongs to others"):
        assert compile_cache.own_folder() is None


def test_a_home_where_nobody_can_write_is_no_obstacle(monkeypatch):
    for home in ("/dev/null", "/proc/none"):
        monkeypatch.setenv("XDG_CACHE_HOME", home)
        assert compile_cache.own_folder() is None
    folder, hits, *_ = run(XDG_CACHE_HOME="/proc/none")
    assert (folder, hits) == (None, 0)


def test_what_the_user_has_set_stands(tmp_path):
    mine = str(tmp_path / "mine")
    environment = {
        "JAX_COMPILATION_CACHE_DIR": mine,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "7",
    }
    folder, *_, least = run(XDG_CACHE_HOME=str(tmp_path), **environment)
    assert (folder, least) == (mine, 7.0)
    before = f"jax.config.update('jax_compilation_cache_dir', {mine!r})\n"
    before += "jax.config.update('jax_enable_compilation_cache', False)"
    folder, *counts, _, _ = run(before, XDG_CACHE_HOME=str(tmp_path))
    assert (folder, counts) == (mine, [0, 0])
    assert not list(tmp_path.glob("beamfit/jax/*"))


ANSWER = """
import sys
from importlib.metadata import version
import beamfit
scan = beamfit.read_quad_scan("measurements/lcls_otr2.csv")
print(beamfit.fit_emittance(scan, beamfit.load_lattice("lattices/lcls_otr2.toml")))
print(beamfit.fit_decay(beamfit.read_decay_record("measurements/aps_1999_decay.csv")))
sys.stderr.write(",".join(sorted(set("{heavy}".split()) & set(sys.modules))))
"""
HEAVY = "matplotlib h5py rich scipy.stats click jinja2 emcee pandas at unopy"


def test_a_first_answer_loads_nothing_that_it_does_not_need(root):
    done = subprocess.run(
        [sys.executable, "-c", ANSWER.format(heavy=HEAVY)],
        cwd=root,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "normalised emittance" in done.stdout
    assert done.stderr == ""


def test_compilation_is_quick_unless_the_user_says_otherwise():
    """XLA would end the process at a flag it does not know."""
    code = (
        "import os; os.environ.pop('XLA_FLAGS', None); from beamfit.compile_cache import *\n"
        "prepare_jax(); prepare_jax(); print(os.environ.get('XLA_FLAGS', 'untried'))\n"
        "import jax.numpy as jnp; print(float(jnp.sin(jnp.arange(3.0)).sum() * 0))\n"
        "own = '--xla_cpu_use_fusion_emitters=true'; os.environ['XLA_FLAGS'] = own\n"
        "prepare_jax(); print(os.environ['XLA_FLAGS'] == own)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    tried = version("jax").startswith(TESTED_JAX)
    flag = "--xla_cpu_use_fusion_emitters=false" if tried else "untried"
    assert done.stdout.split() == [flag, "0.0", "True"]


def test_public_functions_compute_with_one_blas_thread():
    """Whatever the user's threads are, which stand again afterwards."""
    with threadpool_limits(2, user_api="blas"):
        before = threadpool_info()
        within = with_paths(threadpool_info, "threads")()
        assert threadpool_info() == before
    assert {one["num_threads"] for one in within if one["user_api"] == "blas"} == {1}


def test_threads_are_given_back_when_the_last_of_several_calls_ends():
    first, second = usual_arithmetic(), usual_arithmetic()
    with threadpool_limits(2, user_api="blas"):
        before = threadpool_info()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert threadpool_info() != before
        second.__exit__(None, None, None)
        assert threadpool_info() == before


def test_floating_point_errors_that_the_user_raises_do_not_reach_the_fit():
    with np.errstate(all="raise"):
        assert with_paths(lambda: np.exp(-1e4), "underflow")() == 0


@pytest.mark.parametrize(("given", "seen"), [(None, "1"), ("3", "3")])
def test_commands_have_one_blas_thread_unless_the_user_says_otherwise(given, seen):
    script = """if True:
        import atexit, os
        from beamfit.__main__ import THREADS, main
        atexit.register(lambda: print(*(os.environ[name] for name in THREADS)))
        main()"""
    kept = {name: value for name, value in os.environ.items() if name not in THREADS}
    own = {} if given is None else dict.fromkeys(THREADS, given)
    call = [sys.executable, "-c", script, "--version"]
    done = subprocess.run(call, env=kept | own, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-3:] == [seen] * 3
