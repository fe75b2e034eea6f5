"""Scenes far from (0, 0, 0): cameras and points are moved around an origin in float64, then points become float32."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, centres_of
from gsx.core.data.scene import Scene
from gsx.core.shapes import Float
from gsx.formats.origin import NO_ORIGIN, Origin, chosen_origin, in_words, rounding_at, stored_in_single


def origin_of(scene: Scene) -> Origin:
    """Return the origin around which a scene is trained; `NO_ORIGIN` for scenes that float32 resolves.

    Views that are computed from their cameras, not read from files, cannot be moved.
    """
    views = [*scene.train, *scene.test]
    if any(view.file is None for view in views):
        return NO_ORIGIN
    cameras, positions = [view.camera for view in views], scene.points.positions.double()
    distances = (positions - cameras[0].centre.double()).norm(dim=1)
    return origin_of_cameras(cameras, float(distances.median()) if len(positions) else 0.0)


def origin_of_cameras(cameras: Sequence[Camera], least: float = 0.0) -> Origin:
    """Return the origin for cameras: by their median centre, and their mean distance from it or the `least` scale."""
    centres = centres_of(cameras)
    middle = centres.median(0).values
    return chosen_origin(middle, max(least, float((centres - middle).norm(dim=1).mean())))


def around_origin(scene: Scene, origin: Origin) -> Scene:
    """Return the scene with positions relative to an origin, and points in float32; a note says so."""
    points = replace(scene.points, positions=relative(scene.points.positions, origin).float())
    if origin == NO_ORIGIN:
        return scene if scene.points.positions.dtype == torch.float32 else replace(scene, points=points)
    return replace(
        scene,
        origin=origin,
        train=[replace(view, camera=relative_camera(view.camera, origin)) for view in scene.train],
        test=[replace(view, camera=relative_camera(view.camera, origin)) for view in scene.test],
        points=points,
        notes=[*scene.notes, *notes_on(scene, origin)],
    )


def relative(positions: Float[Tensor, "P 3"], origin: Sequence[float]) -> Float[Tensor, "P 3"]:
    """Return positions - origin, float64; without an origin the same tensor."""
    return positions.double() - torch.tensor(origin, dtype=torch.float64) if any(origin) else positions


def relative_camera(camera: Camera, origin: Sequence[float]) -> Camera:
    """Return the camera in coordinates relative to an origin, float64; without an origin the same object."""
    if not any(origin):
        return camera
    shift = camera.rotation.double() @ torch.tensor(origin, dtype=torch.float64)
    return replace(camera, translation=camera.translation.double() + shift)


def notes_on(scene: Scene, origin: Origin) -> list[str]:
    """Return notes on a scene that is trained around an origin."""
    positions = scene.points.positions
    grain = rounding_at(torch.tensor([origin]))
    notes = [
        f"positions are far from (0, 0, 0), where single precision has steps of {grain:.2g} units: trained around "
        f"{in_words(origin)}; splat files, camera paths and the viewer keep the scene's coordinates"
    ]
    if stored_in_single(positions):
        notes.append(
            f"the points are stored in single precision, in steps of {rounding_at(positions):.2g} units: write their "
            "x, y and z as doubles"
        )
    return notes


def focus_of(cameras: Sequence[Camera]) -> Float[Tensor, "3"]:
    """Return the point nearest to the optical axes of all cameras, float64."""
    middle = centres_of(cameras).mean(0)
    system, right = torch.zeros(3, 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    for camera in cameras:
        ahead = camera.rotation[2].double()
        across = torch.eye(3, dtype=torch.float64) - ahead[:, None] * ahead
        system, right = system + across, right + across @ (camera.centre.double() - middle)
    return middle + torch.linalg.lstsq(system, right[:, None], driver="gelsd").solution[:, 0]
