"""Views of photos with an EXIF orientation against those of the same photos without one: pictures, cameras, masks."""

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from refusals import refused
from synthetic_colmap import PINHOLE, colmap_options, synthesize, write_photos, write_scene
from torch import Tensor

from gsx.core.data.images import read_image, write_image
from gsx.core.data.scene import Scene, View
from gsx.core.errors import ConfigError, InputError
from gsx.experiments.viewer.up_direction import upright
from gsx.scenes.colmap import load
from gsx.scenes.exif import orientation_of
from gsx.scenes.orientation import WITHOUT_MIRROR, oriented, oriented_camera
from gsx.scenes.photo_source import PhotoSource

HELD = (6, 1, 8, 3, 6)
"""Orientations of the five photos, by name."""
RADIAL = (80.0, 33.0, 25.0, -0.05)  # focal length, principal point, distortion
LENSES = {"PINHOLE": PINHOLE, "SIMPLE_RADIAL": RADIAL}


def tag(photo: Path, orientation: int) -> None:
    """Store a photo anew with an orientation; its raster stays."""
    buffer = oiio.ImageBuf(np.ascontiguousarray(read_image(photo).permute(1, 2, 0).numpy()))
    buffer.specmod().attribute("Orientation", orientation)
    assert buffer.write(str(photo))
    assert orientation_of(photo) == orientation


def two_scenes(tmp_path: Path, model: str, held: tuple[int, ...]) -> tuple[Path, Path]:
    """The same scene with photos that state orientations, and with photos that state none."""
    reconstruction = synthesize(model, LENSES[model])
    for name in ("held", "plain"):
        write_scene(reconstruction, tmp_path / name)
    for photo, orientation in zip(sorted((tmp_path / "held" / "images").iterdir()), held, strict=True):
        tag(photo, orientation)
    return tmp_path / "held", tmp_path / "plain"


def by_name(scene: Scene) -> dict[str, View]:
    return {view.name: view for view in (*scene.train, *scene.test)}


def pairs(held: Path, plain: Path, **changes: Any) -> list[tuple[View, View, int]]:
    """(view, the same of photos without orientation, the turn between them) of all photos."""
    views, before = (by_name(load(colmap_options(folder, **changes))) for folder in (held, plain))
    stated = {name: orientation_of(held / "images" / name) for name in views}
    return [(views[name], before[name], WITHOUT_MIRROR.get(one, one)) for name, one in sorted(stated.items())]


@pytest.mark.parametrize("model", LENSES)
def test_views_are_those_of_the_stored_photos_turned(tmp_path: Path, model: str) -> None:
    held, plain = two_scenes(tmp_path, model, HELD)
    for view, before, turn in pairs(held, plain):
        assert view.camera.draws_as(oriented_camera(before.camera, turn))
        assert torch.equal(view.image(), oriented(before.image(), turn))
    scene, reference = load(colmap_options(held)), load(colmap_options(plain))
    fits = [note for note in scene.notes if note.startswith("Reprojection")]
    assert fits == [note for note in reference.notes if note.startswith("Reprojection")]
    assert "EXIF turns 4 of 5 photos upright (scene.orientation)." in scene.notes
    assert scene.provenance["turned"] == 4
    assert "turned" not in reference.provenance
    assert scene.extent == pytest.approx(reference.extent)


def test_photos_of_one_lens_are_reduced_alike_however_it_was_held(tmp_path: Path) -> None:
    held, plain = two_scenes(tmp_path, "PINHOLE", HELD)
    for changes in ({"max_width": 32}, {"downscale": 2}, {"principal_point": "centred"}):
        for view, before, turn in pairs(held, plain, **changes):
            assert view.camera.draws_as(oriented_camera(before.camera, turn))
            assert view.image().shape[1:] == (view.camera.height, view.camera.width)
            assert (view.image().int() - oriented(before.image(), turn).int()).abs().max() <= 1


def test_orientations_are_not_heeded_where_that_is_wanted(tmp_path: Path) -> None:
    held, plain = two_scenes(tmp_path, "SIMPLE_RADIAL", HELD)
    scene, reference = load(colmap_options(held, orientation="stored")), load(colmap_options(plain))
    assert scene.provenance | {"path": ""} == reference.provenance | {"path": ""}
    for view, before in zip(scene.train, reference.train, strict=True):
        assert view.camera.draws_as(before.camera)
        assert torch.equal(view.image(), before.image())
    with pytest.raises(ConfigError, match=r"scene\.orientation is 'exif', use one of auto, stored, turned"):
        load(colmap_options(held, orientation="exif"))


@pytest.mark.parametrize(("held", "orientation"), [((6, 8, 5, 7, 6), "auto"), ((3, 2, 4, 3, 2), "turned")])
@pytest.mark.parametrize("model", LENSES)
def test_models_of_turned_photos_get_turned_photos(
    tmp_path: Path, model: str, held: tuple[int, ...], orientation: str
) -> None:
    """Other programs turn photos, and mirror them, before they find cameras; the files are as the phone stored them."""
    reconstruction = synthesize(model, LENSES[model])
    for name in ("held", "plain"):
        write_scene(reconstruction, tmp_path / name)
    inverse = {6: 8, 8: 6}
    for photo, one in zip(sorted((tmp_path / "held" / "images").iterdir()), held, strict=True):
        write_image(photo, oriented(read_image(photo), inverse.get(one, one)))
        tag(photo, one)
    views, before = (
        load(colmap_options(tmp_path / "held", orientation=orientation)),
        load(colmap_options(tmp_path / "plain")),
    )
    for view, other in zip(views.train, before.train, strict=True):
        assert view.camera.draws_as(other.camera)
        assert torch.equal(view.image(), other.image())


def test_mirrored_photos_of_a_model_stay_mirrored_and_a_note_says_so(tmp_path: Path) -> None:
    held, plain = two_scenes(tmp_path, "PINHOLE", (5, 2, 7, 4, 1))
    for view, before, turn in pairs(held, plain):
        assert view.camera.draws_as(oriented_camera(before.camera, turn))
        assert torch.equal(view.image(), oriented(before.image(), turn))
    (note,) = (note for note in load(colmap_options(held)).notes if note.startswith("EXIF mirrors"))
    assert note.startswith(
        "EXIF mirrors 4 photos, but their cameras are those of the stored photos: they stay mirrored ("
    )


def test_photos_turned_since_are_refused_with_the_remedy(tmp_path: Path) -> None:
    reconstruction = synthesize()
    write_scene(reconstruction, tmp_path)
    write_photos(reconstruction, tmp_path / "images", size=(48, 64))
    with pytest.raises(InputError, match=r"48 x 64 .* 64 x 48: use the images .* computed from, which are not turned"):
        load(colmap_options(tmp_path))


def masked_of(view: View) -> Tensor:
    """Which pixels of a view do not count."""
    assert isinstance(view.source, PhotoSource)
    counted = view.source.counted(view.camera)
    assert counted is not None
    return ~counted


@pytest.mark.parametrize("made_for", ["stored", "upright"])
@pytest.mark.parametrize("model", LENSES)
def test_masks_are_turned_by_their_shape(tmp_path: Path, model: str, made_for: str) -> None:
    """A mask file has no orientation: that of a 6 or 8 photo may be as stored (COLMAP) or as a viewer shows it."""
    scenes = two_scenes(tmp_path, model, (6, 8, 6, 8, 6))
    mask = torch.full((3, 48, 64), 255, dtype=torch.uint8)
    mask[:, 5:12, 20:50] = 0
    for folder in scenes:
        (folder / "masks").mkdir()
        for photo in (folder / "images").iterdir():
            turn = orientation_of(photo) if made_for == "upright" else 1
            write_image(folder / "masks" / f"{photo.name}.png", oriented(mask, turn))
    for view, before, turn in pairs(*scenes):
        assert torch.equal(masked_of(view)[None], oriented(masked_of(before)[None], turn))
    if model == "PINHOLE":  # which interpolates nothing, so that nothing more is masked
        assert all(int(masked_of(view).sum()) == 7 * 30 for view, *_ in pairs(*scenes))


def test_masks_of_another_shape_are_refused(tmp_path: Path) -> None:
    held, _ = two_scenes(tmp_path, "PINHOLE", HELD)
    (held / "masks").mkdir()
    photo = next((held / "images").iterdir())
    write_image(held / "masks" / f"{photo.name}.png", torch.ones(3, 40, 64))
    refused(r"masks.* is 64 x 40", load, colmap_options(held))


def test_alpha_is_turned_with_its_photo(tmp_path: Path) -> None:
    held, plain = two_scenes(tmp_path, "PINHOLE", HELD)
    for folder in (held, plain):
        for photo in sorted((folder / "images").iterdir()):
            alpha = torch.full((1, 48, 64), 255, dtype=torch.uint8)
            alpha[:, 30:, 50:] = 0
            orientation = orientation_of(photo)
            write_image(photo, torch.cat([read_image(photo), alpha]), {"Orientation": orientation})
    for view, before, turn in pairs(held, plain, masks="alpha"):
        assert torch.equal(masked_of(view)[None], oriented(masked_of(before)[None], turn))
    for view, before, turn in pairs(held, plain):
        clear, other = view.source.transparent(view.camera), before.source.transparent(before.camera)
        assert torch.equal(clear[None], oriented(other[None], turn))


def test_up_is_where_photographers_held_it(tmp_path: Path) -> None:
    """Cameras of a ring around z, all upright; as their sensors lay, every second picture is on its side."""
    from gsx.core.data.camera import look_at

    cameras = [look_at((3.0 * np.cos(a), 3.0 * np.sin(a), 0.5), (0, 0, 0), fov_x=1.0, width=48, height=64) for a in
               np.linspace(0.3, 2.5, 6)]  # fmt: skip
    lying = [oriented_camera(camera, turn) for camera, turn in zip(cameras, (8, 6, 1, 8, 6, 8), strict=True)]
    turned = [oriented_camera(camera, turn) for camera, turn in zip(lying, (6, 8, 1, 6, 8, 6), strict=True)]
    up = upright(torch.stack([camera.rotation for camera in turned]).double())
    assert up.tolist() == pytest.approx([0, 0, 1], abs=0.05)
    assert not upright(torch.stack([camera.rotation for camera in lying]).double())[2] > 0.95
