"""A restorer learnt on half of the views each, measured on views it has not seen."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from regenerating import Photo, camera, request, stripes
from torch import Tensor

from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import View
from gsx.core.errors import ConfigError, InputError
from gsx.core.training.regenerator import Regenerator, RegeneratorContext
from gsx.regenerators.networks import held_out_pairs, with_own
from gsx.regenerators.scene_restorer import LARGEST_CHANGE, Residual, RestorerOptions, SceneRestorer


def options(**changes: float) -> RestorerOptions:
    values = {"channels": 8, "steps": 80, "later_steps": 10, "again": 1.0, "batch": 4, "crop": 32, "rate": 3e-3}
    values["halves"] = 0.35
    return RestorerOptions(name="scene_restorer", **(values | changes))  # type: ignore[arg-type]


def blurred(image: Tensor) -> Tensor:
    """What a model that has not finished training shows: everything, softly, a little too dark."""
    weights = torch.tensor([1.0, 2, 1]) / 4
    kernel = (weights[:, None] * weights).expand(3, 1, 3, 3)
    padded = torch.nn.functional.pad(image[None], (1, 1, 1, 1), mode="replicate")
    return 0.95 * torch.nn.functional.conv2d(padded, kernel, groups=3)[0]


def context_for(folder: Path, spoil=blurred, count: int = 8) -> RegeneratorContext:
    views = [View(f"photo{i}", camera(), Photo(stripes(i))) for i in range(count)]
    renders = {view.camera: spoil(view.image()) for view in views}
    return RegeneratorContext(
        views=views,
        render=lambda seen: renders[seen],
        held_out=lambda share: list(renders.values()),
        step=40,
        seed=0,
        device=torch.device("cpu"),
        folder=folder,
    )


@pytest.fixture(scope="module")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> tuple[SceneRestorer, dict[str, float]]:
    restorer = SceneRestorer(options())
    return restorer, restorer.prepare(context_for(tmp_path_factory.mktemp("run")))


def restored(restorer: SceneRestorer, image: Tensor, number: int = 0, strength: float = 0.06) -> Tensor:
    asked = replace(request(image, 1), number=number, strength=strength, strongest=0.06)
    return restorer.regenerate([asked])[0]


def test_it_brings_unseen_views_closer_to_their_photographs(learnt: tuple[SceneRestorer, dict[str, float]]) -> None:
    restorer, figures = learnt
    assert isinstance(restorer, Regenerator)
    assert restorer.useful == [True, True]
    for fold in (0, 1):
        assert figures[f"error_restored_{fold}"] < 0.8 * figures[f"error_of_renders_{fold}"]
    truth = stripes(50).float() / 255
    before, after = blurred(truth), restored(restorer, blurred(truth))
    assert float((after - truth).square().mean()) < 0.8 * float((before - truth).square().mean())


def test_views_are_restored_by_the_network_that_has_not_seen_them(
    learnt: tuple[SceneRestorer, dict[str, float]],
) -> None:
    restorer, _ = learnt
    image = blurred(stripes(0).float() / 255)
    with torch.no_grad():
        changes = [network(image[None])[0] for network in restorer.networks]
    for number in (0, 1, 2, 3):  # network n has learnt from views n, n + 2, ...
        torch.testing.assert_close(
            restored(restorer, image, number), (image + changes[(number + 1) % 2]).clamp(0, 1), rtol=0, atol=1e-6
        )


def test_strength_is_a_share_of_the_correction(learnt: tuple[SceneRestorer, dict[str, float]]) -> None:
    restorer, _ = learnt
    image = blurred(stripes(9).float() / 255).clamp(0.2, 0.8)
    whole, third = restored(restorer, image) - image, restored(restorer, image, strength=0.02) - image
    torch.testing.assert_close(third, whole / 3, rtol=1e-4, atol=1e-6)
    assert torch.equal(restored(restorer, image, strength=0.0), image)


def test_one_that_helps_nobody_changes_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Renders that are the photographs already: whatever is learnt can only do harm."""
    restorer = SceneRestorer(options(steps=3))
    figures = restorer.prepare(context_for(tmp_path, spoil=lambda image: image))
    assert figures["error_of_renders_0"] == 0
    assert "changes nothing" in caplog.text
    image = stripes(3).float() / 255
    assert torch.equal(restored(restorer, image), image)


def at_step(given: RegeneratorContext, step: int) -> RegeneratorContext:
    return replace(given, step=step)


def test_a_resumed_run_learns_on_from_the_event_before(tmp_path: Path) -> None:
    """Also when it is resumed at the event itself, whose file is there already."""
    whole, given = SceneRestorer(options(steps=10)), context_for(tmp_path / "run")
    for step in (40, 42, 44):
        whole.prepare(at_step(given, step))
    resumed = SceneRestorer(options(steps=10))
    resumed.prepare(at_step(given, 44))
    for a, b in zip(whole.networks, resumed.networks, strict=True):
        assert all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))
    assert resumed.useful == whole.useful
    assert resumed.prepare(at_step(given, 44)) == {}


def test_it_learns_again_when_the_run_has_become_much_longer(tmp_path: Path) -> None:
    """From 40 by half more each time: at 40, 60 and 90, also for a run that was resumed in between."""
    whole, given = SceneRestorer(options(steps=12, again=1.5)), context_for(tmp_path / "run")
    learnt = [bool(whole.prepare(at_step(given, step))) for step in range(40, 100, 10)]
    assert learnt == [True, False, True, False, False, True]
    resumed = SceneRestorer(options(steps=12, again=1.5))
    assert resumed.prepare(at_step(given, 70)) == {}
    image = blurred(stripes(0).float() / 255)
    assert not torch.equal(restored(resumed, image), image)
    assert resumed.useful == [True, True]


def test_it_learns_from_renders_by_models_that_were_not_fitted_to_the_photographs(tmp_path: Path) -> None:
    """The run's own renders of its training views show nothing to mend; those of half-models do."""
    given, asked = context_for(tmp_path), list[float]()
    photos = {view.camera: view.image() for view in given.views}

    def held_out(share: float) -> list[Tensor]:
        asked.append(share)
        return [blurred(photo) for photo in photos.values()]

    restorer = SceneRestorer(options(steps=40, halves=0.4))
    figures = restorer.prepare(replace(given, render=lambda seen: photos[seen], held_out=held_out))
    assert asked == [0.4]
    expected = sum(float((blurred(photo) - photo).square().mean()) for photo in list(photos.values())[1::2]) / 4
    assert figures["error_of_renders_0"] == pytest.approx(expected)
    assert figures["error_restored_0"] < 0.9 * figures["error_of_renders_0"]
    assert restorer.useful == [True, True]


def test_one_in_seven_renders_is_the_runs_own(tmp_path: Path) -> None:
    """And of the views that the network learns from alone."""
    given = context_for(tmp_path, count=14)
    numbers = {view.camera: number for number, view in enumerate(given.views)}
    own = replace(given, render=lambda seen: torch.full((3, 48, 48), float(numbers[seen])))
    pairs = held_out_pairs(own, 0.3)
    learnt = with_own(pairs, own, range(1, 14, 2))
    assert [float(render.max()) for render, _ in learnt[7:]] == [1.0, 13.0]
    for n, (_, photo) in zip([*range(1, 14, 2), 1, 13], learnt, strict=True):
        assert torch.equal(photo, given.views[n].image())


def test_seeds_share_no_network(tmp_path: Path) -> None:
    """Nor do the two halves: four beginnings of two seeds differ."""
    begun = []
    for seed in (0, 1):
        restorer = SceneRestorer(options())
        networks, _ = restorer.recalled(replace(context_for(tmp_path), seed=seed), [])
        begun += [network.down[0][0].weight.detach() for network in networks]  # type: ignore[index]
    assert not any(torch.equal(a, b) for n, a in enumerate(begun) for b in begun[:n])


def test_networks_of_another_size_are_refused(tmp_path: Path) -> None:
    SceneRestorer(options(steps=1)).prepare(at_step(context_for(tmp_path), 40))
    with pytest.raises(InputError, match="networks of another size"):
        SceneRestorer(options(steps=1, channels=4)).prepare(at_step(context_for(tmp_path), 42))


def test_it_begins_by_changing_nothing_and_never_changes_much() -> None:
    network = Residual(8, torch.Generator().manual_seed(0))
    image = torch.rand(1, 3, 13, 18, generator=torch.Generator().manual_seed(1))
    assert network(image).shape == image.shape
    assert not network(image).any()
    torch.nn.init.constant_(network.last.bias, 1e6)
    torch.testing.assert_close(network(image), torch.full_like(image, LARGEST_CHANGE))


def test_it_needs_views_for_both_halves(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least 4 training views, there are 3"):
        SceneRestorer(options()).check(context_for(tmp_path, count=3).views, [1], True)
    with pytest.raises(ConfigError, match="cannot enlarge x2"):
        SceneRestorer(options()).check(context_for(tmp_path).views, [2], True)


def test_classical_ones() -> None:
    from gsx.regenerators.classical import PlainOptions, Resampled, Unchanged

    image = to_uint8(torch.rand(3, 8, 10, generator=torch.Generator().manual_seed(2))).float() / 255
    assert torch.equal(Unchanged(PlainOptions(name="identity")).regenerate([request(image, 1)])[0], image)
    larger = Resampled(PlainOptions(name="lanczos")).regenerate([request(image, 4)])[0]
    assert larger.shape == (3, 32, 40)
    flat = torch.full((3, 8, 8), 100 / 255)
    torch.testing.assert_close(
        Resampled(PlainOptions(name="lanczos")).regenerate([request(flat, 2)])[0], torch.full((3, 16, 16), 100 / 255)
    )
