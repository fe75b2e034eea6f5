"""Diffusion models as regenerators, on tiny pipelines that are saved and opened as real ones are."""

import json
import math
import shutil
import socket
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from sealed import trained_sealed
from small_scene import small_scene, spread
from tiny import OVERRIDES, tiny_run
from torch import Tensor

from gsx.augmenters.checks import displacement
from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.data.camera import Camera
from gsx.core.data.reduction import as_blocks
from gsx.core.errors import ConfigError, InputError, TrainingError
from gsx.core.training.parameter_table import table_tensors
from gsx.core.training.regenerator import RegeneratorContext, Request
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.open import open_run
from gsx.regenerators.diffusion.model_specs import (
    SD_X2_LATENT,
    SD_X4,
    SDXL_TURBO,
    Batch,
    ModelSpec,
    padded_to,
    steps_for,
)
from gsx.regenerators.diffusion.options import DiffusionOptions
from gsx.regenerators.diffusion.redraw import Cascade, Diffusion, any_pipeline
from gsx.regenerators.diffusion.tuning import closest

pytestmark = [
    pytest.mark.skipif(not (find_spec("diffusers") and find_spec("peft")), reason="needs gsx[diffusion]"),
    pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning"),  # diffusers with numpy 2.4
]

RECIPES = {"sd_x2_latent": SD_X2_LATENT, "sd_x4": SD_X4, "sdxl_turbo": SDXL_TURBO, "sdxl_turbo_raw": SDXL_TURBO}
SIZES = [(1, 1), (1, 9), (7, 5), (33, 65), (65, 33), (64, 64), (1080, 1920), (2048, 1365)]


def tiny() -> ModuleType:
    """Tiny ones; their libraries take seconds to import, also in processes that run none of these tests."""
    import tiny_models

    return tiny_models


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever asks the network fails."""

    def refuse(*args: Any, **more: Any) -> None:
        raise AssertionError("the network was asked")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders of tiny models."""
    return tiny().save_models(tmp_path_factory.mktemp("models"))


def role_of(name: str) -> str:
    """upscale or restore."""
    return RECIPES[name].where.split(".")[1]


@cache
def options_of(name: str, *more: str, model: Path | str = "nowhere") -> DiffusionOptions:
    """Options as the command line gives them."""
    role = role_of(name)
    words = [f"regenerator/{role}={name}", f"regenerator.{role}.model={model}"]
    if name.startswith("sdxl"):
        words.append("regenerator.restore.variant=''")
    else:
        words.append("regenerator.upscale.steps=3")
    return compose([*words, *more], plugins()).regenerators[role].options


def request(image: Tensor, scale: int, seed: int = 22, strength: float = 0.06) -> Request:
    """To redraw a picture."""
    view = small_scene(spread(4)).train[0]
    camera = view.camera.resize(image.shape[2], image.shape[1])
    return Request(
        image=image,
        scale=scale,
        camera=camera,
        view=view,
        number=0,
        photo=True,
        seed=seed,
        strength=strength,
        strongest=0.06,
        prompt="sharp",
        step=1,
    )


class Shown:
    """A photograph in memory."""

    def __init__(self, photo: Tensor) -> None:
        self.photo = photo

    def image(self, camera: Camera) -> Tensor:
        return (self.photo * 255).round().to(torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


def context_for(folder: Path, pairs: list[tuple[Tensor, Tensor]] | None = None) -> RegeneratorContext:
    """Training views that show pairs' photographs, and models that show their renders."""
    scene = small_scene(spread(4), views=len(pairs or [1, 2]))
    views = scene.train
    renders: dict[int, Tensor] = {}
    if pairs:
        height, width = pairs[0][0].shape[1:]
        cameras = [view.camera.resize(width, height) for view in views]
        views = [
            replace(view, camera=camera, source=Shown(photo))
            for view, camera, (_, photo) in zip(views, cameras, pairs, strict=True)
        ]
        renders = {id(view.camera): render for view, (render, _) in zip(views, pairs, strict=True)}
    return RegeneratorContext(
        views=views,
        render=lambda camera: renders[id(camera)],
        held_out=lambda share: [render for render, _ in pairs or []],
        step=1,
        seed=0,
        device=torch.device("cpu"),
        folder=folder,
    )


def ready(name: str, folder: Path, *more: str, model: Path) -> Diffusion:
    """A regenerator with its model in memory."""
    out = Diffusion(RECIPES[name], options_of(name, *more, model=model))
    out.prepare(context_for(folder))
    return out


def noise(height: int, width: int, seed: int = 0) -> Tensor:
    """A picture with every kind of detail, in 8-bit steps."""
    values = torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))
    return (values * 255).round() / 255


def phase_shift(image: Tensor, reference: Tensor) -> tuple[int, int]:
    """(down, right) by which a picture is displaced, px: where the phases of its spectrum and the other's agree."""
    one, other = (torch.fft.fft2(picture.double().mean(0)) for picture in (image, reference))
    product = one * other.conj()
    peaks = torch.fft.ifft2(product / product.abs().clamp_min(1e-12)).real
    row, column = divmod(int(peaks.argmax()), peaks.shape[1])
    height, width = peaks.shape
    return (row + height // 2) % height - height // 2, (column + width // 2) % width - width // 2


def test_the_check_of_phases_sees_a_pixel() -> None:
    """And its direction."""
    image = tiny().pictures(1, 45, 71, torch.Generator().manual_seed(3))[0]
    assert phase_shift(image.roll((1, -2), (1, 2)), image) == (1, -2)


# -- sizes -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("multiple", "least"), [(32, 64), (8, 8), (1, 1)])
def test_pictures_grow_to_what_a_model_takes_and_keep_every_pixel(
    size: tuple[int, int], multiple: int, least: int
) -> None:
    """With no more than half of the addition on the upper left."""
    image = noise(*size)
    larger, inside = padded_to(image, multiple, least)
    assert torch.equal(inside.cut(larger), image)
    for side, before in zip(larger.shape[1:], size, strict=True):
        assert side % multiple == 0
        assert side >= least
        assert side - before < max(multiple, least)


def test_what_is_added_is_the_picture_reflected() -> None:
    """0 1 2 becomes 2 1 | 0 1 2 | 1 0 1: the edge is not repeated, and it goes on beyond the picture's length."""
    row = torch.tensor([0.0, 1.0, 2.0]).expand(3, 1, 3)
    larger, inside = padded_to(row, 8, 8)
    assert (inside.left, inside.top) == (2, 3)
    assert larger[0, 0].tolist() == [2, 1, 0, 1, 2, 1, 0, 1]


class Blocks:
    """A pipeline without flaw: every pixel becomes a block. It complains as real ones do of sizes, or resizes."""

    def __init__(self, spec: ModelSpec) -> None:
        self.spec, self.calls = spec, list[Batch]()

    def __call__(self, pipe: Any, batch: Batch, options: Any) -> Tensor:
        self.calls.append(batch)
        assert all(side % self.spec.multiple == 0 and side >= self.spec.least for side in batch.images.shape[2:])
        return as_blocks(batch.images, self.spec.factor)


def with_call(name: str, call: Callable[..., Tensor], *more: str) -> Diffusion:
    """A regenerator with another pipeline."""
    out = Diffusion(replace(RECIPES[name], call=call), options_of(name, *more))
    out.pipe = object()
    return out


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", ["sd_x2_latent", "sd_x4", "sdxl_turbo"])
def test_results_lie_where_their_pictures_do(name: str, size: tuple[int, int]) -> None:
    """Every size from one pixel to a quarter of 2k, portrait and landscape."""
    if max(size) > 1000:
        size = (size[0] // 4, size[1] // 4)
    spec = RECIPES[name]
    (result,) = with_call(name, Blocks(spec), f"regenerator.{role_of(name)}.cached=false").regenerate(
        [request(noise(*size), spec.factor)]
    )
    assert torch.equal(result, as_blocks(noise(*size), spec.factor))


def test_a_model_that_changes_nothing_gives_its_input_back(models: dict[str, Path], tmp_path: Path) -> None:
    """Through the real pipeline, its autoencoder and its scheduler."""
    turbo = ready("sdxl_turbo_raw", tmp_path, model=models["still"])
    for size in ((1, 1), (7, 5), (19, 41), (41, 19), (48, 64)):
        (result,) = turbo.regenerate([request(noise(*size), 1)])
        assert float((result - noise(*size)).abs().max()) <= 1.01 / 255, size
        assert phase_shift(result, noise(*size)) == (0, 0), size


def test_zero_strength_changes_nothing(models: dict[str, Path], tmp_path: Path) -> None:
    """Though the model is random."""
    turbo = ready("sdxl_turbo_raw", tmp_path, model=models["sdxl_turbo"])
    (result,) = turbo.regenerate([request(noise(19, 41), 1, strength=0.0)])
    assert torch.equal(result, noise(19, 41))


def test_the_latent_upscaler_does_not_shift(models: dict[str, Path], tmp_path: Path) -> None:
    """Its pipeline as it is, with latents that are the picture and a network that knows the answer:

    cond = x / (sigma^2 + 1) + sigma / sqrt(sigma^2 + 1) F, the pipeline's own preconditioning, solved for F.
    """
    upscaler = ready("sd_x2_latent", tmp_path, model=models["sd_x2_latent"])
    pipe = upscaler.pipe
    vae = tiny().autoencoder(1, 1.0)
    tiny().make_transparent(vae)
    pipe.vae = vae
    pipe.vae_scale_factor = 1

    def known(sample: Tensor, timestep: Tensor, **more: Any) -> SimpleNamespace:
        scaled, condition = sample.chunk(2, 1)
        sigma = torch.exp(4 * timestep)
        answer = (condition - scaled / (sigma.square() + 1).sqrt()) * (sigma.square() + 1).sqrt() / sigma
        return SimpleNamespace(sample=torch.cat([answer, answer[:, :1]], 1))

    pipe.unet.forward = known
    image = tiny().pictures(1, 45, 71, torch.Generator().manual_seed(3))[0]
    (result,) = upscaler.regenerate([request(image, 2)])
    assert float((result - as_blocks(image, 2)).abs().max()) <= 1.5 / 255
    assert displacement(result, as_blocks(image, 2)) < 0.01
    assert phase_shift(result, as_blocks(image, 2)) == (0, 0)


# -- calls -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["sd_x2_latent", "sd_x4", "sdxl_turbo_raw"])
def test_results_do_not_depend_on_company_or_order(name: str, models: dict[str, Path], tmp_path: Path) -> None:
    """To a level of 8 bits; and the same call again gives the same bits."""
    spec = RECIPES[name]
    model = models[name.removesuffix("_raw")]
    off = f"regenerator.{role_of(name)}.cached=false"
    together = ready(name, tmp_path, off, model=model)
    alone = ready(name, tmp_path, off, f"regenerator.{role_of(name)}.batch_pixels=1", model=model)
    asked = [request(noise(20, 30, n), spec.factor, seed=n) for n in range(3)]
    asked.insert(1, request(noise(9, 70), spec.factor))
    first, second = together.regenerate(asked), alone.regenerate(asked[::-1])[::-1]
    for a, b, asking in zip(first, second, asked, strict=True):
        assert tuple(a.shape[1:]) == tuple(side * spec.factor for side in asking.image.shape[1:])
        assert float((a - b).abs().max()) <= 1.01 / 255
    assert all(torch.equal(a, b) for a, b in zip(first, together.regenerate(asked), strict=True))
    assert not torch.equal(first[0], together.regenerate([replace(asked[0], seed=99)])[0])


def test_calls_stay_within_their_budget() -> None:
    """Eight pictures of 128 x 128 px results, three at a time."""
    blocks = Blocks(SD_X2_LATENT)
    upscaler = with_call("sd_x2_latent", blocks, f"regenerator.upscale.batch_pixels={3 * 128 * 128}")
    upscaler.regenerate([request(noise(64, 64, n), 2) for n in range(8)])
    assert [len(batch) for batch in blocks.calls] == [3, 3, 2]


def test_scales_that_differ_are_reached_by_so_many_rounds() -> None:
    """x4 is x2 twice."""
    upscaler = with_call("sd_x2_latent", Blocks(SD_X2_LATENT))
    results = upscaler.regenerate([request(noise(5, 6), 2), request(noise(5, 6), 4)])
    assert torch.equal(results[0], as_blocks(noise(5, 6), 2))
    assert torch.equal(results[1], as_blocks(noise(5, 6), 4))


def test_the_ladder_reaches_every_scale_by_the_model_for_it(models: dict[str, Path], tmp_path: Path) -> None:
    """x2 and x4 as these models alone, x8 as x4 then x2; models that no scale needs are not looked for."""
    words = ["regenerator/upscale=sd_by_scale", f"regenerator.upscale.x2.model={models['sd_x2_latent']}"]
    words += ["regenerator.upscale.x2.steps=3", "regenerator.upscale.x4.steps=3"]
    views = small_scene(spread(4)).train
    half = Cascade(compose(words, plugins()).regenerators["upscale"].options)
    half.check(views, [2], False)
    with pytest.raises(InputError, match=r"regenerator.upscale.x4.model="):
        half.check(views, [4], False)
    whole = Cascade(
        compose([*words, f"regenerator.upscale.x4.model={models['sd_x4']}"], plugins()).regenerators["upscale"].options
    )
    whole.check(views, [1, 2, 4, 8], False)
    whole.prepare(context_for(tmp_path))
    image = noise(9, 13)
    two, eight, one, four = whole.regenerate([request(image, scale) for scale in (2, 8, 1, 4)])
    assert torch.equal(one, image)
    (alone,) = ready("sd_x2_latent", tmp_path, model=models["sd_x2_latent"]).regenerate([request(image, 2)])
    x4 = ready("sd_x4", tmp_path, model=models["sd_x4"])
    (fourfold,) = x4.regenerate([request(image, 4)])
    (after,) = ready("sd_x2_latent", tmp_path, model=models["sd_x2_latent"]).regenerate([request(fourfold, 2)])
    for found, expected in ((two, alone), (four, fourfold), (eight, after)):
        assert found.shape == expected.shape
        assert float((found - expected).abs().max()) <= 1.01 / 255
    with pytest.raises(ConfigError, match="x2, x4, x8, not x6"):
        whole.check(views, [6], False)


@pytest.mark.parametrize(
    ("name", "scales", "complaint"),
    [
        ("sd_x2_latent", [3], "x2, x4, x8, not x3"),
        ("sd_x4", [2], "x4, x16, x64, not x2"),
        ("sdxl_turbo_raw", [2], "cannot enlarge x2"),
    ],
)
def test_scales_out_of_reach_are_refused(name: str, scales: list[int], complaint: str) -> None:
    """Before training."""
    with pytest.raises(ConfigError, match=complaint):
        Diffusion(RECIPES[name], options_of(name)).check(small_scene(spread(4)).train, scales, False)


def test_flat_pictures_of_other_shapes_are_not_taken_for_one_another() -> None:
    low, wide = (
        Batch(images=torch.ones(2, 3, *size), prompts=["sharp"] * 2, seeds=[22, 23], strength=0.06)
        for size in ((16, 24), (24, 16))
    )
    assert low.contents() != wide.contents()
    assert low.contents()[0] != low.contents()[1]


def test_one_step_is_executed_at_every_strength() -> None:
    """Spec 1.2: 17 steps at .06, 100 at .01."""
    assert (steps_for(0.06, 0), steps_for(0.0489, 0), steps_for(0.01, 0)) == (17, 21, 101)
    assert all(int(steps_for(n / 10000, 0) * n / 10000) == 1 for n in (*range(100, 601), 9_999, 10_000))


def test_batches_that_do_not_fit_are_halved_and_one_picture_is_an_error() -> None:
    """A GPU and the CPU say so in other words."""
    blocks = Blocks(SD_X4)

    def scarce(pipe: Any, batch: Batch, options: Any) -> Tensor:
        if len(batch) > 2:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")
        return blocks(pipe, batch, options)

    results = with_call("sd_x4", scarce).regenerate([request(noise(8, 8, n), 4) for n in range(5)])
    assert [len(batch) for batch in blocks.calls] == [2, 1, 2]
    assert all(torch.equal(result, as_blocks(noise(8, 8, n), 4)) for n, result in enumerate(results))

    def none_left(pipe: Any, batch: Batch, options: Any) -> Tensor:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory")

    with pytest.raises(TrainingError, match=r"one picture of 8 x 8 px: set regenerator.upscale.tiling=true"):
        with_call("sd_x4", none_left).regenerate([request(noise(5, 5, 77), 4)])


def test_results_are_kept_and_taken_again(models: dict[str, Path], tmp_path: Path) -> None:
    """By another run too; not for another seed; and never what is not finite."""
    asked = [request(noise(20, 30, 50 + n), 4) for n in range(2)]
    first = ready("sd_x4", tmp_path, model=models["sd_x4"]).regenerate(asked)
    again = ready("sd_x4", tmp_path, model=models["sd_x4"])
    again.spec = replace(again.spec, call=lambda *more: pytest.fail("drawn again"))
    assert all(torch.equal(a, b) for a, b in zip(first, again.regenerate(asked), strict=True))
    with pytest.raises(pytest.fail.Exception):
        again.regenerate([replace(asked[0], seed=1)])
    broken = ready("sd_x4", tmp_path, model=models["sd_x4"])
    broken.spec = replace(broken.spec, call=lambda pipe, batch, options: as_blocks(batch.images / 0, 4))
    for _ in range(2):
        assert not bool(torch.isfinite(broken.regenerate([request(noise(5, 5, 60), 4)])[0]).all())


def test_any_pipeline_is_called_as_its_options_say(models: dict[str, Path], tmp_path: Path) -> None:
    """The x4 upscaler described by options alone draws what the named one draws."""
    words = [
        "regenerator/upscale=diffusers_pipeline",
        f"regenerator.upscale.model={models['sd_x4']}",
        "regenerator.upscale.scale=4",
        "regenerator.upscale.least=8",
        "regenerator.upscale.steps=3",
        "regenerator.upscale.guidance=1",
        "+regenerator.upscale.arguments.noise_level=20",
    ]
    general = any_pipeline(compose(words, plugins()).regenerators["upscale"].options)
    general.check(small_scene(spread(4)).train, [4], True)
    general.prepare(context_for(tmp_path))
    asked = [request(noise(20, 30), 4)]
    named = ready("sd_x4", tmp_path, model=models["sd_x4"])
    assert torch.equal(general.regenerate(asked)[0], named.regenerate(asked)[0])


@pytest.mark.parametrize("name", ["num_inference_steps", "guidance_scale"])
def test_arguments_that_are_given_already_are_refused_at_once(name: str) -> None:
    words = ["regenerator/upscale=diffusers_pipeline", f"+regenerator.upscale.arguments.{name}=2"]
    with pytest.raises(ConfigError, match=f"arguments may not hold {name}: gsx sets them"):
        compose([*words, "regenerator.upscale.model=m"], plugins())


def test_a_pipeline_of_ones_own_is_opened_from_its_file(models: dict[str, Path], tmp_path: Path) -> None:
    """A subclass that turns pictures to grey."""
    file = tmp_path / "greying.py"
    file.write_text(
        "from diffusers import StableDiffusionXLImg2ImgPipeline\n\n\n"
        "class Greying(StableDiffusionXLImg2ImgPipeline):\n"
        "    def __call__(self, image, **more):\n"
        "        from types import ModuleType, SimpleNamespace\n\n"
        "        return SimpleNamespace(images=image.mean(1, keepdim=True).expand(-1, 3, -1, -1))\n"
    )
    words = ["regenerator/restore=diffusers_pipeline", f"regenerator.restore.model={models['sdxl_turbo']}"]
    words.append(f"regenerator.restore.custom={file}")
    general = any_pipeline(compose(words, plugins()).regenerators["restore"].options)
    general.check(small_scene(spread(4)).train, [1], True)
    general.prepare(context_for(tmp_path))
    (result,) = general.regenerate([request(noise(9, 13), 1)])
    assert float((result - noise(9, 13).mean(0)).abs().max()) <= 0.51 / 255


def test_a_pipeline_that_gives_something_else_is_an_error() -> None:
    """Another size, or pictures that are no tensor."""
    larger = with_call("sd_x2_latent", lambda pipe, batch, options: as_blocks(batch.images, 4))
    with pytest.raises(TrainingError, match=r"its results are \(1, 3, 256, 256\) and should be \(1, 3, 128, 128\)"):
        larger.regenerate([request(noise(64, 64, 31), 2)])
    listed = with_call("sd_x2_latent", lambda pipe, batch, options: ["picture"])
    with pytest.raises(TrainingError, match="regenerator sd_x2_latent failed: AttributeError"):
        listed.regenerate([request(noise(64, 64, 32), 2)])


def test_a_pipeline_is_shown_the_photograph_of_the_training_view() -> None:
    """Of the size of the picture, and by its own argument; a prompt of its own takes the place of the augmenter's."""
    words = ["regenerator/restore=diffusers_pipeline", "regenerator.restore.model=x/y"]
    words += ["regenerator.restore.reference=ref_image", "regenerator.restore.prompt=repair"]
    general = any_pipeline(compose(words, plugins()).regenerators["restore"].options)
    given: dict[str, Any] = {}

    def pipe(**arguments: Any) -> SimpleNamespace:
        given.update(arguments)
        return SimpleNamespace(images=arguments["ref_image"])

    general.pipe = pipe
    asked = request(noise(70, 90), 1)
    (result,) = general.regenerate([asked])
    assert given["prompt"] == ["repair"]
    assert given["num_inference_steps"] == 1
    assert tuple(given["ref_image"].shape) == tuple(given["image"].shape) == (1, 3, 72, 96)
    assert torch.allclose(result, asked.view.image().mean().expand(3, 70, 90))


@pytest.mark.parametrize(
    ("word", "complaint"),
    [
        ("model=''", "model is empty"),
        ("custom=pipeline", "ending in .py"),
        ("custom=nowhere.py", "there is no file custom=nowhere.py"),
        ("+arguments.prompt=sharp", "may not hold prompt"),
        ("steps=0", "steps is 0; give a number from 1"),
        ("dtype=half", "dtype is 'half'"),
        ("offload=all", "offload is 'all'"),
    ],
)
def test_options_that_cannot_be_are_named(word: str, complaint: str, models: dict[str, Path]) -> None:
    """Before training."""
    words = ["regenerator/restore=diffusers_pipeline", f"regenerator.restore.model={models['still']}"]
    with pytest.raises((ConfigError, InputError), match=complaint):
        any_pipeline(
            compose([*words, f"{'+' * word.startswith('+')}regenerator.restore.{word.lstrip('+')}"], plugins())
            .regenerators["restore"]
            .options
        ).check(small_scene(spread(4)).train, [1], False)


# -- what can be wrong with a model ------------------------------------------------------------------------------------


def refused(name: str, model: Path | str, *more: str) -> str:
    """What `check` says of a model."""
    with pytest.raises(InputError) as caught:
        Diffusion(RECIPES[name], options_of(name, *more, model=model)).check(small_scene(spread(4)).train, [1], False)
    return str(caught.value)


def test_a_model_that_is_not_here_is_named_with_the_command_that_fetches_it() -> None:
    """Files, size, place, command; and the network is not asked."""
    told = refused("sdxl_turbo", "stabilityai/sdxl-turbo")
    for part in (
        "finds no model 'stabilityai/sdxl-turbo'",
        "model_index.json and the folders vae, text_encoder, text_encoder_2, unet, tokenizer, tokenizer_2, scheduler",
        "6.9 GB",
        "hf download stabilityai/sdxl-turbo",
        "regenerator.restore.model=models/sdxl-turbo",
        "regenerator.restore.download=true",
    ):
        assert part in told
    assert "no id of the form owner/model" in refused("sdxl_turbo", "a b/c d")


def test_the_network_is_asked_only_when_told_to() -> None:
    """The socket that fails above is reached, and the failure is one sentence."""
    told = refused("sdxl_turbo", "stabilityai/sdxl-turbo", "regenerator.restore.download=true")
    assert "the network was asked" in told


@pytest.fixture
def copied(models: dict[str, Path], tmp_path: Path) -> Path:
    """A model to be damaged."""
    return Path(shutil.copytree(models["sdxl_turbo"], tmp_path / "copied"))


def test_another_architecture_is_refused(models: dict[str, Path]) -> None:
    """By the name in its index."""
    told = refused("sdxl_turbo", models["sd_x4"])
    assert "is that of a StableDiffusionUpscalePipeline, and must be that of a StableDiffusionXLPipeline" in told


def test_missing_and_damaged_files_are_named(copied: Path) -> None:
    """One after the other is broken."""
    weights = copied / "unet" / "diffusion_pytorch_model.safetensors"
    content = weights.read_bytes()
    weights.write_bytes(content[: len(content) // 2])
    assert f"{weights} is damaged" in refused("sdxl_turbo", copied)
    weights.unlink()
    assert "lacks unet/*.safetensors" in refused("sdxl_turbo", copied)
    assert "lacks vae/*.fp16.safetensors" in refused("sdxl_turbo", copied, "regenerator.restore.variant=fp16")
    shutil.rmtree(copied / "tokenizer")
    assert "lacks tokenizer, unet/*.safetensors" in refused("sdxl_turbo", copied)
    (copied / "model_index.json").write_text("{")
    assert "model_index.json cannot be read" in refused("sdxl_turbo", copied)
    (copied / "model_index.json").unlink()
    assert "holds no model_index.json" in refused("sdxl_turbo", copied)


def test_weights_of_a_variant_are_not_those_without(copied: Path) -> None:
    """A folder with one kind is refused where the other is asked for."""
    for path in copied.glob("*/*.safetensors"):
        path.rename(path.with_name(f"{path.stem}.fp16.safetensors"))
    assert "lacks vae/*.safetensors" in refused("sdxl_turbo", copied)
    fine = options_of("sdxl_turbo", "regenerator.restore.variant=fp16", model=copied)
    Diffusion(SDXL_TURBO, fine).check(small_scene(spread(4)).train, [1], False)


def test_a_folder_that_is_not_there_is_no_id(tmp_path: Path) -> None:
    """The command names the model's own id."""
    told = refused("sd_x4", "models/stable-diffusion-x4-upscaler")
    assert "hf download stabilityai/stable-diffusion-x4-upscaler" in told


def test_a_model_that_passes_the_look_and_cannot_be_loaded_is_one_sentence(copied: Path, tmp_path: Path) -> None:
    """A configuration that does not fit its weights."""
    path = copied / "unet" / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"in_channels": 9}))
    with pytest.raises(TrainingError, match=r"copied cannot be loaded \(\w+: .*\); fetch the model again"):
        ready("sdxl_turbo_raw", tmp_path, model=copied)


# -- tuning ------------------------------------------------------------------------------------------------------------

TUNING = [
    f"regenerator.restore.tuning.{word}"
    for word in (
        "steps=20",
        "rank=4",
        "rate=1e-2",
        "warm_up=5",
        "crop=16",
        "crops=16",
        "held_out=0.25",
        "layers=[to_q,to_k,to_v,to_out.0,conv1,conv2,conv_out]",
    )
]


def worn(photos: Tensor) -> list[tuple[Tensor, Tensor]]:
    """(render, photograph): renders are too dark."""
    return [((photo - 0.2).clamp(0, 1), photo) for photo in photos]


@pytest.fixture
def pairs() -> list[tuple[Tensor, Tensor]]:
    """Eight of 32 x 40 px."""
    return worn(tiny().pictures(8, 32, 40, torch.Generator().manual_seed(1)))


@pytest.mark.parametrize("dtype", ["float32", pytest.param("bfloat16", marks=pytest.mark.slow)])
def test_tuning_lowers_the_error_on_views_it_has_not_seen(
    dtype: str, pairs: list[tuple[Tensor, Tensor]], models: dict[str, Path], tmp_path: Path
) -> None:
    """Below that of the model as it was, and below that of the renders; a second run of the scene learns nothing anew,
    and both restore alike."""
    options = options_of("sdxl_turbo", *TUNING, f"regenerator.restore.dtype={dtype}", model=models["useful"])
    first = Diffusion(SDXL_TURBO, options)
    figures = first.prepare(context_for(tmp_path / "first", pairs))
    assert figures["error_tuned"] < 0.5 * figures["error_raw"]
    assert figures["error_tuned"] < 0.5 * figures["error_of_renders"]
    facts = json.loads((tmp_path / "first" / "sdxl_turbo" / "adapter.json").read_text())
    assert facts["used"]
    assert facts["views"] == [f"view{n}" for n in range(8)]
    second = Diffusion(SDXL_TURBO, options)
    assert second.prepare(context_for(tmp_path / "second", pairs)) == figures
    fresh = worn(tiny().pictures(2, 33, 41, torch.Generator().manual_seed(2)))
    for number, (render, photo) in enumerate(fresh):
        asked = request(render, 1, seed=number)
        (one,), (other,) = first.regenerate([asked]), second.regenerate([asked])
        assert torch.equal(one, other)
        assert float((one - photo).square().mean()) < 0.5 * float((render - photo).square().mean())


@pytest.mark.parametrize("rate", [10.0, 1e20])
def test_an_adapter_that_does_harm_is_not_used(
    rate: float,
    pairs: list[tuple[Tensor, Tensor]],
    models: dict[str, Path],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Learnt at a rate that ruins it, or ends in no number; restored pictures are those of the model as it was."""
    sound = options_of("sdxl_turbo", *TUNING, "regenerator.restore.tuning.steps=4", model=models["useful"])
    tuned = Diffusion(SDXL_TURBO, replace(sound, tuning=replace(sound.tuning, rate=rate)))
    figures = tuned.prepare(context_for(tmp_path, pairs))
    assert not figures["error_tuned"] <= figures["error_raw"]
    assert all(isinstance(value, float) for value in figures.values())
    assert "the model stays as it is" in caplog.text
    raw = ready("sdxl_turbo_raw", tmp_path / "raw", model=models["useful"])
    asked = [request(pairs[0][0], 1)]
    assert torch.equal(tuned.regenerate(asked)[0], raw.regenerate(asked)[0])


def test_an_adapter_that_beats_the_model_but_not_the_renders_is_not_used(
    models: dict[str, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Renders a little too dark: tuning brings them back, and what the autoencoder loses is more than that."""
    photos = tiny().pictures(8, 32, 40, torch.Generator().manual_seed(1))
    pairs = [((photo - 0.04).clamp(0, 1), photo) for photo in photos]
    tuned = Diffusion(SDXL_TURBO, options_of("sdxl_turbo", *TUNING, model=models["useful"]))
    figures = tuned.prepare(context_for(tmp_path, pairs))
    assert figures["error_of_renders"] < figures["error_tuned"] < figures["error_raw"]
    facts = json.loads((tmp_path / "sdxl_turbo" / "adapter.json").read_text())
    assert (facts["used"], facts["best"]) == (False, "renders")
    assert "regenerator/restore=identity" in caplog.text
    raw = ready("sdxl_turbo_raw", tmp_path / "raw", model=models["useful"])
    asked = [request(pairs[0][0], 1)]
    assert torch.equal(tuned.regenerate(asked)[0], raw.regenerate(asked)[0])


def test_what_is_closest_to_the_photographs() -> None:
    """Of equals what changes least; what is no number is far off."""
    for errors, best in (
        ((3.0, 2.0, 1.0), "tuned"),
        ((3.0, 1.0, 2.0), "raw"),
        ((1.0, 3.0, 2.0), "renders"),
        ((1.0, 1.0, 1.0), "renders"),
        ((3.0, 1.0, 1.0), "raw"),
        ((3.0, math.nan, math.nan), "renders"),
    ):
        names = ("error_of_renders", "error_raw", "error_tuned")
        assert closest(dict(zip(names, errors, strict=True))) == best


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_tuning_learns_and_measures_on_held_out_renders(dtype: str, models: dict[str, Path], tmp_path: Path) -> None:
    """A run whose own renders are the photographs is not measured on these."""
    pairs = worn(tiny().pictures(8, 32, 40, torch.Generator().manual_seed(1)))
    few = [*TUNING, *(f"regenerator.restore.tuning.{word}" for word in ("steps=2", "crops=4", "halves=0.4"))]
    few.append(f"regenerator.restore.dtype={dtype}")
    given, asked = context_for(tmp_path, pairs), list[float]()
    photos = {id(view.camera): view.image() for view in given.views}

    def held_out(share: float) -> list[Tensor]:
        asked.append(share)
        return given.held_out(share)

    fitted = replace(given, render=lambda camera: photos[id(camera)], held_out=held_out)
    figures = Diffusion(SDXL_TURBO, options_of("sdxl_turbo", *few, model=models["useful"])).prepare(fitted)
    assert asked == [0.4]
    measured = [pairs[n] for n in (2, 6)]  # a quarter of eight, their middles
    expected = sum(float((a - b)[:, 8:24, 12:28].square().mean()) for a, b in measured) / 2
    assert figures["error_of_renders"] == pytest.approx(expected, rel=0.02)


def test_a_damaged_adapter_is_named(
    pairs: list[tuple[Tensor, Tensor]], models: dict[str, Path], tmp_path: Path
) -> None:
    """Not learnt again behind the user's back: the run had another one."""
    few = [*TUNING, "regenerator.restore.tuning.steps=2", "regenerator.restore.tuning.crops=4"]
    options = options_of("sdxl_turbo", *few, model=models["useful"])
    Diffusion(SDXL_TURBO, options).prepare(context_for(tmp_path, pairs))
    (tmp_path / "sdxl_turbo" / "adapter.safetensors").write_bytes(b"nothing")
    with pytest.raises(TrainingError, match="is damaged"):
        Diffusion(SDXL_TURBO, options).prepare(context_for(tmp_path, pairs))


def test_an_adapter_of_another_model_is_not_merged(
    pairs: list[tuple[Tensor, Tensor]], models: dict[str, Path], tmp_path: Path
) -> None:
    """A run continues with the model with which it began."""
    few = [*TUNING, "regenerator.restore.tuning.steps=2", "regenerator.restore.tuning.crops=4"]
    Diffusion(SDXL_TURBO, options_of("sdxl_turbo", *few, model=models["useful"])).prepare(context_for(tmp_path, pairs))
    for other in (
        options_of("sdxl_turbo", *few, model=models["still"]),
        options_of("sdxl_turbo", *few, "regenerator.restore.tuning.rank=2", model=models["useful"]),
    ):
        with pytest.raises(TrainingError, match="use those with which the run began"):
            Diffusion(SDXL_TURBO, other).prepare(context_for(tmp_path, pairs))


def test_a_damaged_adapter_in_the_cache_is_learnt_again(
    pairs: list[tuple[Tensor, Tensor]], models: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And a cache that cannot be written costs nothing but the sharing."""
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    few = [*TUNING, "regenerator.restore.tuning.steps=2", "regenerator.restore.tuning.crops=4"]
    options = options_of("sdxl_turbo", *few, model=models["useful"])
    Diffusion(SDXL_TURBO, options).prepare(context_for(tmp_path / "first", pairs))
    (kept,) = (tmp_path / "cache" / "lora").glob("*/adapter.safetensors")
    content = kept.read_bytes()
    kept.write_bytes(b"nothing")
    Diffusion(SDXL_TURBO, options).prepare(context_for(tmp_path / "second", pairs))
    assert (tmp_path / "second" / "sdxl_turbo" / "adapter.safetensors").read_bytes() == content == kept.read_bytes()
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "file"))
    Diffusion(SDXL_TURBO, options).prepare(context_for(tmp_path / "third", pairs))
    assert (tmp_path / "third" / "sdxl_turbo" / "adapter.safetensors").read_bytes() == content


def test_packages_that_are_not_installed_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the command; those that only tuning needs, only for it."""
    monkeypatch.setattr("gsx.core.packages.find_spec", lambda name: None)
    views = small_scene(spread(4)).train
    told = r"needs diffusers, transformers, accelerate{}: pip install 'gsx\[diffusion\]'"
    for name, more in (("sd_x4", ""), ("sdxl_turbo_raw", ""), ("sdxl_turbo", ", peft")):
        with pytest.raises(ConfigError, match=told.format(more)):
            Diffusion(RECIPES[name], options_of(name)).check(views, [1], False)


def test_an_adapter_that_the_clock_has_cut_short_is_the_runs_alone(
    pairs: list[tuple[Tensor, Tensor]], models: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    hurried = [*TUNING, "regenerator.restore.tuning.seconds=0.001", "regenerator.restore.tuning.crops=4"]
    Diffusion(SDXL_TURBO, options_of("sdxl_turbo", *hurried, model=models["useful"])).prepare(
        context_for(tmp_path / "run", pairs)
    )
    assert not json.loads((tmp_path / "run" / "sdxl_turbo" / "adapter.json").read_text())["whole"]
    assert not list((tmp_path / "cache").glob("lora/*/adapter.safetensors"))


def test_half_precision_is_not_tuned() -> None:
    """Its gradients vanish."""
    with pytest.raises(ConfigError, match="gradients vanish in dtype=float16"):
        options_of("sdxl_turbo", "regenerator.restore.dtype=float16")
    options_of("sdxl_turbo_raw", "regenerator.restore.dtype=float16")


# -- the whole ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def whole(models: dict[str, Path]) -> list[str]:
    """The mission's command with tiny models; pictures of an upscaler with random weights must be put right."""
    return [
        "backbone=octree_scaffold",
        "augmenter=[upscale,bootstrap]",
        "regenerator/upscale=sd_x2_latent",
        "regenerator/restore=sdxl_turbo",
        f"regenerator.upscale.model={models['sd_x2_latent']}",
        f"regenerator.restore.model={models['still']}",
        "regenerator.restore.variant=''",
        *TUNING,
        "regenerator.restore.tuning.steps=2",
        "regenerator.restore.tuning.crops=4",
        "regenerator.upscale.steps=3",
        "augmenter.upscale.project=exact",
        "augmenter.upscale.timing.start=24000",  # windows of three steps, after 6 and 9
        *(f"augmenter.{name}.timing.{word}=12000" for name in ("upscale", "bootstrap") for word in ("every", "span")),
        "scene.train_views=4",
        "scene.points=100",
        "eval.zoom=[1]",
        "iterations=10",  # bootstrapping: windows after 5 and 8
    ]


def test_the_whole_run_end_to_end(whole: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupted inside the windows and resumed it gives the same bits as in one go; neither finds anything kept."""
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "one"))
    run = tiny_run(tmp_path / "whole", whole)
    assert run.complete
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "other"))
    tiny_run(tmp_path / "halves", whole, stop_after=7)
    assert main(["resume", str(tmp_path / "halves")]) == 0
    resumed, _ = open_run(tmp_path / "halves", plugins())
    assert all(
        torch.equal(value, table_tensors(resumed.backbone.table)[name])
        for name, value in table_tensors(run.backbone.table).items()
    )
    one, other = (
        json.loads((tmp_path / name / "pseudo" / "index.json").read_text())["views"] for name in ("whole", "halves")
    )
    assert {view["augmenter"] for view in one} == {"upscale", "bootstrap"}
    assert [view["sha256"] for view in one] == [view["sha256"] for view in other]


def test_a_model_that_cannot_be_loaded_costs_no_training(
    whole: list[str], copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run ends at its first event in one message, keeps its state, and goes on once the model is mended."""
    path = copied / "unet" / "config.json"
    sound = path.read_text()
    path.write_text(json.dumps(json.loads(sound) | {"in_channels": 9}))
    words = [word for word in whole if "restore" not in word and "tuning" not in word]
    words += ["augmenter=bootstrap", "regenerator/restore=sdxl_turbo_raw", f"regenerator.restore.model={copied}"]
    words += ["regenerator.restore.variant=''", "augmenter.bootstrap.strength=[0,0]", "backbone=gs3d"]
    words = [word for word in words if "upscale" not in word and "octree" not in word]
    folder = tmp_path / "run"
    assert main([*OVERRIDES, *words, f"folder={folder}"]) == 2
    assert "cannot be loaded" in capsys.readouterr().err
    assert json.loads((folder / "status.json").read_text())["step"] == 5
    path.write_text(sound)
    assert main(["resume", str(folder)]) == 0
    assert json.loads((folder / "status.json").read_text()) == {"state": "ok", "reason": "", "step": 10}


def test_the_whole_run_needs_no_held_out_picture(
    whole: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor does tuning, which measures itself on training views."""
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    run = trained_sealed(tmp_path / "run", whole, monkeypatch)
    assert (run.folder / "regenerators" / "sdxl_turbo" / "adapter.json").is_file()
