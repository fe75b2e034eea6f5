"""Super-resolution learnt from a scene: better than a filter on unseen texture, true to its input."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from regenerating import EDGE, Photo, camera, request, strict_checks, stripes
from torch import Tensor

from gsx.augmenters.checks import defect, violations
from gsx.core.data.reduction import Reduction, box_average, projected
from gsx.core.data.resize import resize, to_uint8
from gsx.core.data.scene import View
from gsx.core.errors import ConfigError
from gsx.core.training.regenerator import Regenerator, RegeneratorContext
from gsx.engine.machine import multiplies_bfloat16
from gsx.regenerators import scene_sr
from gsx.regenerators.scene_sr import Enlarger, SceneSR, SceneSROptions, crop, kept_at, pairs

CPU = torch.device("cpu")
BOX, BICUBIC = Reduction(), Reduction(filter="bicubic")


def context_for(folder: Path, count: int = 6) -> RegeneratorContext:
    views = [View(f"photo{i}", camera(), Photo(stripes(i))) for i in range(count)]
    return RegeneratorContext(
        views=views,
        render=lambda seen: torch.zeros(3, seen.height, seen.width),
        held_out=lambda share: [],
        step=1,
        seed=0,
        device=torch.device("cpu"),
        folder=folder,
    )


def options(**changes: float) -> SceneSROptions:
    values = {
        "channels": 16,
        "layers": 3,
        "steps": 800,
        "batch": 8,
        "crop": 16,
        "rate": 2e-3,
        "noise": 0.5,
        "seconds": 0,
    }
    return SceneSROptions(name="scene_sr", **(values | changes))  # type: ignore[arg-type]


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> SceneSR:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GSX_CACHE", str(tmp_path_factory.mktemp("cache")))
        regenerator = SceneSR(options())
        regenerator.prepare(context_for(tmp_path_factory.mktemp("run"), 12))
    return regenerator


def error(image: Tensor, truth: Tensor) -> float:
    return float((image - truth).square().mean())


def test_it_enlarges_unseen_texture_better_than_a_filter(learnt: SceneSR) -> None:
    assert isinstance(learnt, Regenerator)
    gains = []
    for seed in range(100, 106):
        truth = stripes(seed).float() / 255
        low = to_uint8(box_average(truth, 2))
        (result,) = learnt.regenerate([request(low.float() / 255)])
        plain = resize(low, EDGE, EDGE, "lanczos").float() / 255
        gains.append(error(plain, truth) / error(result, truth))
    assert sorted(gains)[2] > 1.5, gains


def test_what_it_makes_reduces_to_what_it_was_given(learnt: SceneSR) -> None:
    for scale in (2, 4, 8):
        low = stripes(7, 12).float() / 255
        given = request(low, scale)
        (result,) = learnt.regenerate([given])
        assert result.shape == (3, 12 * scale, 12 * scale)
        assert float((box_average(result, scale) - low).abs().max()) < 2 / 255
        assert defect(given, result) == ""
        assert violations(given, result, strict_checks()) == {}


def test_it_learns_and_enlarges_by_the_scenes_own_reduction(tmp_path: Path) -> None:
    """Pairs are bicubic halves of what lies around them too; what it makes reduces bicubically."""
    slope = (torch.arange(96.0)[:, None] + 2 * torch.arange(96.0)) / 400
    low, truth = pairs([slope.expand(3, -1, -1)], BICUBIC, options(), torch.Generator().manual_seed(0))
    assert (low.shape, truth.shape) == ((8, 3, 16, 16), (8, 3, 32, 32))
    torch.testing.assert_close(low, box_average(truth, 2))  # of a slope every symmetric filter leaves the middle
    regenerator = SceneSR(options(steps=30))
    regenerator.prepare(replace(context_for(tmp_path), reduction=BICUBIC))
    for scale in (2, 4):
        given = replace(request(stripes(7, 12).float() / 255, scale), reduction=BICUBIC)
        (result,) = regenerator.regenerate([given])
        off = 255 * BICUBIC.inner(BICUBIC.reduce(result, scale) - given.image).abs()
        assert float(off.mean()) < 0.5, scale


def test_before_learning_it_is_the_bicubic_enlargement() -> None:
    network = Enlarger(8, 2, torch.Generator().manual_seed(0))
    image = torch.rand(1, 3, 9, 11, generator=torch.Generator().manual_seed(1))
    plain = torch.nn.functional.interpolate(image, scale_factor=2, mode="bicubic", align_corners=False)
    torch.testing.assert_close(network(image), plain)


def test_learning_in_bfloat16_changes_little_and_pictures_are_drawn_without(learnt: SceneSR) -> None:
    assert learnt.network is not None
    image = stripes(7, 24).float()[None] / 255
    exact, fast = (learnt.network(image, fast).detach() for fast in (False, True))
    assert fast.dtype == torch.float32
    assert 0 < float((exact - fast).abs().max()) < 0.02
    (result,) = learnt.regenerate([request(image[0])])
    assert torch.equal(result, projected(exact[0], image[0], 2, BOX))


def test_it_learns_in_bfloat16_where_that_is_faster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, found = request(stripes(3, 12).float() / 255), []
    for faster in (True, False):  # neither finds what the other has learnt
        monkeypatch.setattr(scene_sr, "multiplies_bfloat16", lambda device, faster=faster: faster)
        regenerator = SceneSR(options(steps=5))
        assert "loss" in regenerator.prepare(context_for(tmp_path))
        found.append(regenerator.regenerate([given])[0])
    assert 0 < float((found[0] - found[1]).abs().max()) < 0.02


@pytest.mark.parametrize(
    ("told", "wanted"), [({"amx_bf16": True}, True), ({"avx2": True, "avx512_bf16": False}, False)]
)
def test_bfloat16_is_for_processors_that_multiply_it(told: dict, wanted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: told, raising=False)
    assert multiplies_bfloat16(CPU) == wanted
    monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert not multiplies_bfloat16(CPU)


def test_what_was_learnt_is_found_again(tmp_path: Path) -> None:
    first, again = SceneSR(options(steps=5)), SceneSR(options(steps=5))
    assert "loss" in first.prepare(context_for(tmp_path))
    assert again.prepare(context_for(tmp_path)) == {"learnt_before": 1.0}
    given = request(stripes(3, 12).float() / 255)
    assert torch.equal(first.regenerate([given])[0], again.regenerate([given])[0])
    assert first.prepare(context_for(tmp_path)) == {}


def test_a_damaged_file_is_learnt_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    first, again = SceneSR(options(steps=5)), SceneSR(options(steps=5))
    first.prepare(context_for(tmp_path))
    photos = [view.image() for view in context_for(tmp_path).views]
    kept_at(options(steps=5), photos, BOX, 0, CPU).write_bytes(b"no network")
    assert "loss" in again.prepare(context_for(tmp_path))
    assert "computing it again" in caplog.text
    given = request(stripes(3, 12).float() / 255)
    assert torch.equal(first.regenerate([given])[0], again.regenerate([given])[0])


def test_other_photographs_are_another_scene(tmp_path: Path) -> None:
    photos = [view.image() for view in context_for(tmp_path).views]
    assert kept_at(options(), photos, BOX, 0, CPU) != kept_at(options(), photos[:-1], BOX, 0, CPU)
    assert kept_at(options(), photos, BOX, 0, CPU) != kept_at(options(), photos, BICUBIC, 0, CPU)
    assert kept_at(options(), photos, BOX, 0, CPU) != kept_at(options(steps=7), photos, BOX, 0, CPU)
    assert kept_at(options(), photos, BOX, 0, CPU) != kept_at(options(), photos, BOX, 1, CPU)


def test_the_time_is_limited_and_its_result_not_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    hurried = options(steps=100_000, seconds=0.2)
    SceneSR(hurried).prepare(context_for(tmp_path))
    assert "regenerator.upscale.seconds" in caplog.text
    assert not kept_at(hurried, [view.image() for view in context_for(tmp_path).views], BOX, 0, CPU).exists()


def test_crops_are_of_every_orientation_and_place() -> None:
    photo = torch.arange(3 * 20 * 20.0).view(3, 20, 20)
    generator = torch.Generator().manual_seed(0)
    corners = {tuple(crop([photo], 8, generator)[0, [0, 0, -1], [0, -1, 0]].tolist()) for _ in range(2000)}
    assert len(corners) == 8 * 5 * 5


def test_only_powers_of_two(learnt: SceneSR) -> None:
    learnt.check([], [1, 2, 4, 8], True)
    with pytest.raises(ConfigError, match="x2, x4, x8, not x3"):
        learnt.check([], [2, 3], True)


def test_options_are_checked() -> None:
    with pytest.raises(ValueError, match=r"regenerator\.upscale\.rate is 0, by which nothing is learnt"):
        options(rate=0)
