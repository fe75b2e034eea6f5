"""Set-up that tests of scenes share."""

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own."""
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"
