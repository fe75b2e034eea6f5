"""What holds for the process in which a run is built."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gsx.engine.cache import MANIFEST, trim
from gsx.experiments.runs.build import convolve_exactly, keep_compiled_code, plan_of
from gsx.experiments.runs.environment import in_words


def test_convolutions_on_a_gpu_are_those_of_float32() -> None:
    """Of which torch keeps ten bits unless told otherwise, and whose sums it adds in any order."""
    cudnn = torch.backends.cudnn
    before = cudnn.conv.fp32_precision, cudnn.deterministic
    cudnn.conv.fp32_precision, cudnn.deterministic = "tf32", False
    try:
        convolve_exactly()
        assert (cudnn.conv.fp32_precision, cudnn.deterministic) == ("ieee", True)
    finally:
        cudnn.conv.fp32_precision, cudnn.deterministic = before


@dataclass
class Telling:
    """A backbone with a schedule."""

    told: dict[str, Any]

    def plan(self) -> dict[str, Any]:
        return self.told


@pytest.mark.parametrize(
    "told", [{"grows every": 4, "until": [1.5, 20]}, {"mine": {"grows every": 4, "until": [1.5, 20]}}]
)
def test_a_plan_may_have_parts_or_none(told: dict[str, Any]) -> None:
    run: Any = SimpleNamespace(config={"backbone": {"name": "mine"}}, backbone=Telling(told), modules={}, augmenters={})
    assert plan_of(run) == {"mine": {"grows every": 4, "until": [1.5, 20]}}
    assert [in_words(value) for value in (4, 0.25, [1.5, 20], [], True, "soon", None)] == [
        *("4", "0.25", "1.5 20", "none", "1", "soon", "None")
    ]


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


def test_the_compiler_takes_the_settings_that_hasten_it() -> None:
    """In a process of its own: torch reads them once."""
    code = (
        "from gsx.experiments.runs.build import keep_compiled_code; keep_compiled_code(); "
        "from torch._dynamo import config as tracing; from torch._inductor import config as writing; "
        "print(tracing.fake_tensor_cache_enabled, writing.cpp.vec_isa_ok)"
    )
    unset = {name: value for name, value in os.environ.items() if not name.startswith("TORCH")}
    ended = subprocess.run([sys.executable, "-c", code], env=unset, capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["False", "True"]
