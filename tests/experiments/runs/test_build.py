"""What holds for the process in which a run is built."""

import os
from pathlib import Path

import pytest

from gsx.core.cache import MANIFEST, trim
from gsx.experiments.runs.build import keep_compiled_code


def test_compiled_code_is_kept_in_an_entry_of_the_cache_or_where_torch_keeps_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "")
    for place, kept in (("file", False), ("cache", True)):
        monkeypatch.setenv("GSX_CACHE", str(tmp_path / place))
        os.environ.pop("TORCHINDUCTOR_CACHE_DIR", None)
        keep_compiled_code()
        assert ("TORCHINDUCTOR_CACHE_DIR" in os.environ) is kept
    entry = Path(os.environ["TORCHINDUCTOR_CACHE_DIR"])
    (entry / "ab").mkdir()
    (entry / "ab" / "kernel.so").write_bytes(bytes(1000))
    os.utime(entry / MANIFEST, (1, 1))  # used by nobody since
    assert trim(0) == [entry]
    assert not entry.exists()
