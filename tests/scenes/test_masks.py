"""Masks: which pixels count, where they are looked for, and that the others change nothing."""

import json

import numpy as np
import pytest
import torch
from refusals import refused

import gsx
from gsx.core.data.camera import look_at
from gsx.core.data.images import ImageCache, read_image, write_image
from gsx.core.data.masks import Mask, black_out
from gsx.core.data.reduction import Reduction
from gsx.core.data.resize import ResizeRule
from gsx.core.data.scene import View
from gsx.core.errors import ConfigError, InputError
from gsx.core.quality.losses import ssim_map
from gsx.core.quality.metrics import psnr, ssim
from gsx.modules.derived_views import reduce_view
from gsx.scenes.masked import candidates, masks_named
from gsx.scenes.photo_source import PhotoSource
from tests.synthetic_colmap import synthesize, write_scene

NOISE = torch.Generator().manual_seed(3)


def stored_mask(path, excluded, size=(8, 8)):
    """A white mask but for the pixels (row, column) in `excluded`."""
    picture = torch.full((3, *size), 255, dtype=torch.uint8)
    for row, column in excluded:
        picture[:, row, column] = 0
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, picture)
    return path


def places(mask, value=False):
    return {tuple(place) for place in (mask[0] == value).nonzero().tolist()}


def test_a_reduced_pixel_counts_where_nothing_it_was_made_from_is_masked(tmp_path):
    mask = Mask(path=stored_mask(tmp_path / "m.png", [(0, 7)]))
    whole = (8, 8)
    assert places(mask.reduced(8, 8, "bicubic", whole)) == {(0, 7)}, "as it is"
    assert places(mask.reduced(4, 4, "area", whole)) == {(0, 3)}
    assert places(mask.reduced(4, 4, "bicubic", whole)) == {(row, column) for row in range(3) for column in (1, 2, 3)}
    enlarged = {(0, 14), (0, 15), (1, 14), (1, 15)}
    assert places(mask.reduced(16, 16, "bicubic", (16, 16))) == enlarged, "a mask half as fine as its photograph"
    assert len(places(mask.reduced(4, 4, "bicubic", (16, 16)))) == 9, "whose own size says nothing of the filter"
    assert places(mask.reduced(1, 1, "area", whole)) == {(0, 0)}


def test_no_masked_pixel_reaches_a_counted_one_through_any_filter(tmp_path):
    """Against the resize itself: two photographs that differ where they are masked alone are equal where they count."""
    from gsx.core.data.resize import resize

    generator = torch.Generator().manual_seed(0)
    for filter in ("area", "bicubic", "lanczos"):
        excluded = torch.rand(40, 56, generator=generator) < 0.002
        mask = Mask(path=stored_mask(tmp_path / f"{filter}.png", excluded.nonzero().tolist(), (40, 56)))
        one = torch.randint(0, 256, (3, 40, 56), generator=generator, dtype=torch.uint8)
        other = torch.where(excluded, 255 - one, one)
        for width, height in ((56, 40), (57, 41), (28, 20), (17, 11)):
            counted = mask.reduced(width, height, filter, (56, 40))[0]
            same = (resize(one, width, height, filter) == resize(other, width, height, filter)).all(0)
            assert bool(same[counted].all()), (filter, width)
            assert 0 < counted.float().mean() < 1


@pytest.mark.parametrize("filter", ["area", "bicubic", "lanczos"])
def test_no_masked_pixel_reaches_a_counted_one_of_a_coarse_view(filter):
    """Two photographs that differ where they are masked alone."""
    generator = torch.Generator().manual_seed(0)
    excluded = torch.rand(128, 160, generator=generator) < 0.001
    one = torch.randint(0, 256, (3, 128, 160), generator=generator, dtype=torch.uint8)

    class Photo:
        def __init__(self, picture):
            self.picture = picture

        def image(self, camera):
            return self.picture

        def counted(self, camera):
            return ~excluded

        def max_zoom(self, camera):
            return 1.0

    camera = look_at((0, -3, 0), (0, 0, 0), fov_x=0.7, width=160, height=128)
    for times in (2, 4):
        views = [
            reduce_view(View("a", camera, Photo(picture)), Reduction(filter=filter), times)
            for picture in (one, torch.where(excluded, 255 - one, one))
        ]
        counted = views[0].counted()
        assert 0.1 < float(counted.float().mean()) < 1
        assert bool(((views[0].image() == views[1].image()).all(0))[counted].all()), times


def test_other_masks_are_another_protocol(tmp_path):
    def named(places):
        views = []
        for number in range(2):
            photo = tmp_path / f"{number}.png"
            write_image(photo, torch.zeros(3, 8, 8))
            mask = Mask(path=stored_mask(tmp_path / f"{number}_mask.png", places))
            camera = look_at((0, -3, 0), (0, 0, 0), fov_x=0.7, width=8, height=8)
            rule = ResizeRule(filter="area", light="display", background=(0, 0, 0))
            source = PhotoSource(path=photo, whole=camera, rule=rule, cache=ImageCache(10**6), mask=mask)
            views.append(View(str(number), camera, source))
        return masks_named(views)

    first, again, other = named([(0, 1)]), named([(0, 1)]), named([(0, 2)])
    assert first == again
    assert (first["masks"], other["masks"]) == (2, 2)
    assert first["masks_content"] != other["masks_content"]
    assert masks_named([]) == {}


def test_alpha_counts_where_opaque(tmp_path):
    picture = torch.full((4, 4, 4), 255, dtype=torch.uint8)
    picture[3, 0, 0], picture[3, 1, 1] = 0, 254
    write_image(tmp_path / "a.png", picture)
    assert places(Mask(path=tmp_path / "a.png", alpha=True).reduced(4, 4, "area", (4, 4))) == {(0, 0), (1, 1)}


def test_figures_are_over_what_counts():
    image, truth = (torch.rand(3, 30, 40, generator=NOISE) for _ in range(2))
    counted = torch.rand(30, 40, generator=NOISE) < 0.7
    errors = ((image - truth) ** 2).numpy()[:, counted.numpy()].astype(np.float64)
    assert psnr(image, truth, counted) == pytest.approx(-10 * np.log10(errors.mean()), abs=1e-4)
    shown = [black_out(picture, counted) for picture in (image, truth)]
    assert float(shown[0][:, ~counted].abs().sum()) == 0
    padded = ssim_map(*shown)[:, counted].mean()
    assert ssim(*shown, "inria", counted) == pytest.approx(float(padded), abs=1e-6)
    inner = counted[5:-5, 5:-5]
    assert ssim(*shown, "valid", inner.new_ones(30, 40)) == pytest.approx(ssim(*shown, "valid"), abs=1e-9)
    assert ssim(*shown, "valid", counted) == pytest.approx(float(ssim_map(*shown, 0)[:, inner].mean()), abs=1e-6)


def test_where_a_mask_may_lie(tmp_path):
    names = [str(path.relative_to(tmp_path)) for path in candidates(tmp_path, "images/a.jpg")]
    assert {"images/a.jpg.png", "images/a.jpg", "images/a.png", "a.jpg.png", "a.png", "a.webp", "a.tif"} <= set(names)


def test_a_photograph_is_not_its_own_mask(tmp_path):
    """Names in a file of poses may be whole paths, or lead out of the folder."""
    for name in ("/abs/images/0.png", "../images/0.png"):
        assert all(path.is_relative_to(tmp_path) and ".." not in path.parts for path in candidates(tmp_path, name))


def test_no_masked_pixel_reaches_a_counted_one_through_undistortion(tmp_path, monkeypatch):
    """Two photographs through a bent lens that differ where they are masked alone."""
    import pycolmap

    from gsx.scenes.undistort import StoredUndistortion, pinhole_of, undistort

    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=120, height=80, params=[90.0, 60.0, 40.0, -0.08])
    pinhole, size = pinhole_of(lens), (112, 76)
    generator = torch.Generator().manual_seed(1)
    excluded = torch.rand(80, 120, generator=generator) < 0.003
    path = stored_mask(tmp_path / "m.png", excluded.nonzero().tolist(), (80, 120))
    mask = Mask(path=path, remap=StoredUndistortion(path, lens, pinhole, size))
    one = torch.randint(0, 256, (3, 80, 120), generator=generator, dtype=torch.uint8)
    straight = [undistort(photo, lens, pinhole, size) for photo in (one, torch.where(excluded, 255 - one, one))]
    counted = mask.reduced(*size, "bicubic", size)[0]
    assert bool((straight[0] == straight[1]).all(0)[counted].all())
    assert 0.5 < counted.float().mean() < 1


def test_masks_of_another_shape_are_refused(tmp_path):
    write_scene(synthesize(frames=3), tmp_path)
    for photo in sorted((tmp_path / "images").rglob("*.*")):
        stored_mask(tmp_path / "masks" / f"{photo.relative_to(tmp_path / 'images')}.png", [], (64, 48))
    refused(r"The mask '.*' is 48 x 64 and its photo 64 x 48: give it the photo's", trained, tmp_path, tmp_path / "run")


def test_alpha_of_opaque_photographs_is_told(tmp_path):
    write_scene(synthesize(frames=3), tmp_path)
    with pytest.raises(InputError, match="no photograph has alpha"):
        trained(tmp_path, tmp_path / "run", "scene.masks=alpha")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A COLMAP scene of noise of which a corner of every photograph is masked."""
    folder = tmp_path_factory.mktemp("masked")
    write_scene(synthesize(frames=5), folder)
    for photo in sorted((folder / "images").rglob("*.*")):
        height, width = read_image(photo).shape[1:]
        corner = [(row, column) for row in range(height // 2) for column in range(width // 2)]
        name = photo.relative_to(folder / "images").as_posix()
        stored_mask(folder / "masks" / f"{name}.png", corner, (height, width))
    return folder


def trained(folder, output, *more):
    return gsx.train(
        "scene=colmap", "backbone=mip_splatting", "iterations=4", "device=cpu", "eval.zoom=[1]", *more,
        **{"scene.path": str(folder), "folder": str(output)},
    )  # fmt: skip


def test_what_is_masked_changes_nothing(capture, tmp_path):
    """Other pixels under the masks: the same model and the same figures, bit by bit. Without masks: another."""
    runs = [trained(capture, tmp_path / "one")]
    for photo in sorted((capture / "images").rglob("*.*")):
        picture = read_image(photo)
        picture[:, : picture.shape[1] // 2, : picture.shape[2] // 2] = 255 * (int(photo.stem[-1]) % 2)
        write_image(photo, picture)
    runs += [trained(capture, tmp_path / "two"), trained(capture, tmp_path / "three", "scene.masks=none")]
    one, two, three = (
        {name: value.detach() for name, value in run.run.backbone.table.parameters.items()} for run in runs
    )
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert not all(torch.equal(one[name], three[name]) for name in one)
    figures = [json.loads((tmp_path / name / "evaluation.json").read_text()) for name in ("one", "two", "three")]
    assert figures[0]["psnr"] == figures[1]["psnr"] != figures[2]["psnr"]
    assert figures[0]["protocol"]["scene"]["masks"] == 5
    assert "masks" not in figures[2]["protocol"]["scene"]
    assert any("masks of 5 of 5" in note for note in runs[0].scene.notes)


def test_masks_that_belong_to_nothing_are_told(tmp_path):
    write_scene(synthesize(frames=3), tmp_path)
    stored_mask(tmp_path / "masks" / "other.png", [(0, 0)])
    refused(r"None of the masks .*a\.jpg\.png.*scene\.masks=none", trained, tmp_path, tmp_path / "run")
    with pytest.raises(ConfigError, match=r"scene\.masks is 'alfa'.*alpha"):
        trained(tmp_path, tmp_path / "run", "scene.masks=alfa")


def test_a_mask_that_leaves_nothing_is_told(tmp_path):
    write_scene(synthesize(frames=3), tmp_path)
    for photo in sorted((tmp_path / "images").rglob("*.*")):
        black = torch.zeros_like(read_image(photo))
        mask = tmp_path / "masks" / f"{photo.relative_to(tmp_path / 'images')}.png"
        mask.parent.mkdir(parents=True, exist_ok=True)
        write_image(mask, black)
    refused("leaves nothing of", trained, tmp_path, tmp_path / "run")
