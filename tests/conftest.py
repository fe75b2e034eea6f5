"""Shape annotations are checked in every test (jaxtyping and beartype); single-threaded torch."""

import gc
import os
from collections import Counter
from collections.abc import Iterator
from getpass import getuser
from importlib.util import find_spec
from pathlib import Path
from tempfile import gettempdir

import pytest
from hypothesis import settings
from processes import Begin, default_signals, killed_at_the_end

os.environ.setdefault("HYDRA_FULL_ERROR", "0")
for switch, value in {"TORCHINDUCTOR_VEC_ISA_OK": "1", "TORCH_FAKE_TENSOR_DISPATCH_CACHE": "0"}.items():
    os.environ.setdefault(switch, value)  # as runs do (build.py)
# by content, so that it may serve all tests and the next time, too: runs would name one below their private cache
os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(Path(gettempdir()) / f"torchinductor_{getuser()}"))


def pytest_addoption(parser: pytest.Parser) -> None:
    """make test-times."""
    parser.addoption("--file-times", action="store_true", help="say how long the tests of each file took")


def pytest_terminal_summary(terminalreporter, config: pytest.Config) -> None:
    """Seconds by file, the longest first."""
    if not config.getoption("--file-times"):
        return
    seconds: Counter[str] = Counter()
    for report in (report for reports in terminalreporter.stats.values() for report in reports):
        seconds[getattr(report, "nodeid", "").split("::")[0]] += getattr(report, "duration", 0.0)
    terminalreporter.section("seconds by file")
    for file, spent in seconds.most_common():
        terminalreporter.write_line(f"{spent:8.1f}  {file}")


COMPILED = {
    *(f"gsx.core.rasterizer.{name}" for name in ("geometry", "selection", "boxes")),
    *("gsx.core.gaussians.bands", "gsx.core.quality.similarity", "gsx.engine.compiling"),
}
"""torch.compile must see these functions themselves, not the checks around them."""


def checked_modules() -> list[str]:
    """Every module of core, formats and backbones but the compiled ones; the hook takes a package with all below it."""
    spec = find_spec("gsx")
    root = Path(next(iter(spec.submodule_search_locations)))
    files = [
        file
        for part in ("core", "formats", "backbones")
        for file in (root / part).rglob("*.py")
        if file.stem != "__init__"
    ]
    names = {".".join(file.relative_to(root.parent).with_suffix("").parts) for file in files}
    return sorted(names - COMPILED)


try:
    import jaxtyping
    import shape_checks
except ImportError:  # tests of an installed wheel may run without the development extras
    shape_checks = None
else:
    jaxtyping.jaxtyped = shape_checks.sometimes
    jaxtyping.install_import_hook(checked_modules(), "shape_checks.check")


settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")  # the same cases on every run


def pytest_collection_finish():
    """What is imported by now stays: to look through it for garbage took a twentieth of the time."""
    gc.freeze()


@pytest.fixture(scope="module")
def signals() -> Iterator[None]:
    """Signals end processes as they do in a terminal, also under `nohup` and in the background."""
    with default_signals():
        yield


@pytest.fixture
def begin(signals: None) -> Iterator[Begin]:
    """`subprocess.Popen` for processes that are killed after the test, however it ends."""
    with killed_at_the_end() as begin:
        yield begin


@pytest.fixture(autouse=True, scope="session")
def no_watched_cores(tmp_path_factory):
    """Hides how long threads wait: a thread that watches cores outlives its test and disturbs others."""
    from gsx.engine import threads

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threads, "TASKS", tmp_path_factory.mktemp("tasks"))
        yield


@pytest.fixture(autouse=True, scope="session")
def groups_composed_once():
    """Most tests that compose change values alone."""
    import hydra
    from composing import composed_once

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hydra, "compose", composed_once)
        yield


@pytest.fixture(autouse=True)
def shapes_of_every_test():
    """Each test has its functions' first calls checked."""
    if shape_checks:
        shape_checks.calls.clear()


@pytest.fixture(autouse=True)
def private_cache(tmp_path_factory, monkeypatch):
    """No test reads or writes the user's cache; one cache serves the session."""
    folder = tmp_path_factory.getbasetemp() / "gsx-cache"
    monkeypatch.setenv("GSX_CACHE", str(folder))
