"""Where the reference numbers are, and the two real lines every test may use."""

import ctypes
import gc
import os
import signal
from importlib.metadata import version
from pathlib import Path

import pytest
from hypothesis import settings

from beamfit.compile_cache import FUSION_FLAG, TESTED_JAX

# Compiling is most of the tests' time: do it without optimisation, in one part, and by the older of
# XLA's two ways to emit fused loops, which takes a third of the time, and keep it for the next run.
# A flag that XLA does not know ends the process.
_QUICK = f"--xla_backend_optimization_level=0 --{FUSION_FLAG}=false"
_QUICK += " --xla_llvm_disable_expensive_passes=true --xla_cpu_parallel_codegen_split_count=1"
if version("jax").startswith(TESTED_JAX):
    os.environ.setdefault("XLA_FLAGS", _QUICK)
# No test reads which line of Python an instruction of a compiled program came from.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
_CACHE = Path(__file__).resolve().parents[1] / ".pytest_cache" / "jax"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

# A shell's background job ignores Ctrl-C and so would the commands that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The first example of a test compiles JAX code: its time says nothing.
settings.register_profile("beamfit", deadline=None, max_examples=40, derandomize=True)
settings.load_profile("beamfit")

ROOT = Path(__file__).resolve().parents[1]
# JAX keeps every program it compiled; past this many MB they are dropped between two tests.
# Those that are needed again come from the cache on disk.
MOST_MEMORY = 2500


def resident():
    """Memory of this process in MB; 0 where the system does not say."""
    pages = Path("/proc/self/statm")
    if not pages.exists():
        return 0.0
    return int(pages.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


class _Programs:
    """Drops programs between two tests; as a fixture it would not see the examples in beamfit."""

    def pytest_runtest_teardown(self):
        if resident() > MOST_MEMORY:
            import jax

            jax.clear_caches()
            gc.collect()
            # What is freed is given back, or every test after this one would drop its own, too.
            if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
                trim(0)


def pytest_collection_finish():
    # Modules are there to stay: they are not searched for rubbish again with every traced program.
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


def pytest_configure(config):
    config.pluginmanager.register(_Programs())


@pytest.fixture(scope="session")
def root():
    return ROOT


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """A Chromium, or None where there is none (tests/report/test_in_browser.py says so)."""
    from tests.report.browser import NAME, Chromium

    one = Chromium(tmp_path_factory.mktemp("chromium")) if NAME else None
    yield one
    if one:
        one.close()


@pytest.fixture
def well_shown(browser):
    """Look at a page on a telephone, a screen and paper: what is wrong with it."""
    from tests.report.browser import WIDTHS

    def look(page, pictures):
        return [f for w in WIDTHS if browser for f in browser.faults(page, w, pictures)]

    return look


@pytest.fixture(scope="session")
def shared():
    """Reference numbers and measurements kept beside a checkout; not part of a clone."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("no ../shared beside this checkout")
    return folder
