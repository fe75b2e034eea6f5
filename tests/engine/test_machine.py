"""Processors are told from each other where compiled code of one may hold instructions that another lacks."""

import os
import platform
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from gsx.engine import machine
from gsx.engine.machine import device_name, machine_stamp, processor_kind
from gsx.experiments.runs.build import keep_compiled_code

OLD = """processor\t: 0
vendor_id\t: GenuineIntel
model name\t: Intel(R) Xeon(R) Gold 6148 CPU @ 2.40GHz
cpu MHz\t\t: 2399.998
flags\t\t: fpu avx2 avx512f

processor\t: 1
model name\t: another
"""
NEW = OLD.replace("avx512f", "avx512f avx512_bf16 amx_tile").replace("Gold 6148", "Platinum 8481C")
BUSY = OLD.replace("2399.998", "3100.000")


@pytest.fixture(autouse=True)
def asked_anew() -> Iterator[None]:
    machine.processor_fields.cache_clear()
    yield
    machine.processor_fields.cache_clear()


def on(told: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[str, ...]:
    """The kind of a processor of which a system tells so."""
    monkeypatch.setattr(machine, "PROCESSORS", tmp_path / "cpuinfo")
    (tmp_path / "cpuinfo").unlink(missing_ok=True)
    if told is not None:
        (tmp_path / "cpuinfo").write_text(told)
    machine.processor_fields.cache_clear()
    return processor_kind()


def test_a_processor_is_known_by_what_it_can(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = [on(told, tmp_path, monkeypatch) for told in (OLD, BUSY, NEW, None)]
    assert kinds[0] == kinds[1]
    assert len(set(kinds)) == 3
    assert device_name(torch.device("cpu")) == (platform.processor() or platform.machine())
    on(NEW, tmp_path, monkeypatch)
    assert device_name(torch.device("cpu")) == "Intel(R) Xeon(R) Platinum 8481C CPU @ 2.40GHz"


def test_nothing_compiled_for_one_processor_is_found_by_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a cluster they share a home."""
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "as it was")
    folders, stamps = [], []
    for told in (OLD, NEW, BUSY):
        on(told, tmp_path, monkeypatch)
        del os.environ["TORCHINDUCTOR_CACHE_DIR"]
        keep_compiled_code()
        folders.append(os.environ["TORCHINDUCTOR_CACHE_DIR"])
        stamps.append(machine_stamp(torch.device("cpu")))
    assert folders[0] == folders[2] != folders[1]
    assert stamps[0] == stamps[2] != stamps[1]
