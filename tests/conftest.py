"""Shape annotations are checked on every call in the tests (jaxtyping and beartype); single-threaded torch."""

import os

import pytest
from hypothesis import settings

os.environ.setdefault("HYDRA_FULL_ERROR", "0")

try:
    from jaxtyping import install_import_hook
except ImportError:  # tests of an installed wheel may run without the development extras
    pass
else:
    install_import_hook(["gsx.core", "gsx.backbones"], "shape_checks.check")


settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")  # the same cases on every run


@pytest.fixture(autouse=True)
def private_cache(tmp_path_factory, monkeypatch):
    """No test reads or writes the user's cache; one cache serves the session."""
    folder = tmp_path_factory.getbasetemp() / "gsx-cache"
    monkeypatch.setenv("GSX_CACHE", str(folder))
