"""Photographs made worse in a known way, so that the truth of what finds and mends them is known (research alone)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import FromFile, ImageSource, Masked, Scene, View
from gsx.core.errors import ConfigError
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Bool, Float, UInt8
from gsx.modules.movement import motion_blurred
from gsx.modules.pinned import as_taken

BALANCE = 0.25
"""Spread of a channel's own gain, of that of the exposure."""
MOST = {"exposure": 2.0, "shade": 2.0, "pose": 64.0, "blur": 16.0, "covered": 0.9, "some": 1.0}
"""What photographs may suffer, and the largest value of each."""


@runtime_checkable
class Disturbable(Protocol):
    """Options of a scene whose photographs may be made worse."""

    @property
    def disturb(self) -> Mapping[str, float]:
        """By what, and how much."""
        ...


def places_in_frame(camera: Camera) -> tuple[Float[Tensor, "W"], Float[Tensor, "H"]]:
    """Centres of columns and of rows of pixels, as shares of the frame's sides."""
    frame = camera.frame
    columns = (torch.arange(camera.width) + 0.5 + frame.left) / frame.width
    return columns, (torch.arange(camera.height) + 0.5 + frame.top) / frame.height


@dataclass(frozen=True, eq=False, kw_only=True)
class Patch:
    """Something plain in front of a camera."""

    edges: tuple[float, float, float, float]
    """Left, top, right, bottom, as shares of the frame's sides."""
    colour: UInt8[Tensor, "3"]

    def over(self, image: UInt8[Tensor, "3 H W"], camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """The image with it: pixels whose centres it covers."""
        (left, top, right, bottom), (x, y) = self.edges, places_in_frame(camera)
        covered = ((y >= top) & (y < bottom))[:, None] & ((x >= left) & (x < right))
        return torch.where(covered.to(image.device), self.colour.to(image.device)[:, None, None], image)


@dataclass(frozen=True, eq=False, kw_only=True)
class Worse:
    """A source of a photograph that was taken in other light, by a moving camera, with something in the way."""

    source: ImageSource
    gains: Float[Tensor, "3"] | None = None
    """Display values are multiplied by them, and saturate."""
    slopes: tuple[float, float] | None = None
    """Of log gains of display values, to the right and down, from the middle of the frame to its sides."""
    patch: Patch | None = None
    movement: tuple[float, float] | None = None
    """Across and down, as shares of the frame's sides, while it was exposed."""

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """What was photographed."""
        image = (
            self.source.image(camera)
            if self.movement is None
            else with_motion_blur(self.source, camera, *self.movement)
        )
        if self.gains is not None or self.slopes is not None:
            light = self.light(camera).to(image.device)
            image = (image * light).round().clamp(0, 255).to(torch.uint8)
        return image if self.patch is None else self.patch.over(image, camera)

    def light(self, camera: Camera) -> Float[Tensor, "3 h w"]:
        """Gains of display values: of all pixels alike, h and w are 1 then, or of each."""
        gains = (torch.ones(3) if self.gains is None else self.gains)[:, None, None]
        if self.slopes is None:
            return gains
        (right, down), (x, y) = self.slopes, (2 * places - 1 for places in places_in_frame(camera))
        return gains * (right * x + down * y[:, None]).exp()

    def max_zoom(self, camera: Camera) -> float:
        """That of the source."""
        return self.source.max_zoom(camera)

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """That of the source."""
        return self.source.counted(camera) if isinstance(self.source, Masked) else None


@dataclass(frozen=True, eq=False, kw_only=True)
class WorseFile(Worse):
    """The same of a source that reads a file."""

    @property
    def path(self) -> Path:
        """The file that the source reads."""
        assert isinstance(self.source, FromFile)
        return self.source.path


def with_motion_blur(source: ImageSource, camera: Camera, across: float, down: float) -> UInt8[Tensor, "3 H W"]:
    """What a camera sees that moves by such shares of the frame's sides; of a crop the part of the whole frame."""
    frame = camera.frame
    whole = source.image(camera.crop(-frame.left, -frame.top, frame.width, frame.height)).float()
    taken = motion_blurred(whole, across * frame.width, down * frame.height).round().clamp(0, 255).to(torch.uint8)
    return taken[:, frame.top : frame.top + camera.height, frame.left : frame.left + camera.width]


# -- what one photograph suffers ---------------------------------------------------------------------------------------


def generator_of(kind: str, name: str) -> torch.Generator:
    """Of one photograph's numbers: the same in every run, whatever the seed."""
    return torch.Generator().manual_seed(derived_seed(f"disturbed {kind}", name))


def gains_of(name: str, spread: float) -> Float[Tensor, "3"]:
    """Gains of the photograph of that name."""
    drawn = torch.randn(4, generator=generator_of("exposure", name))
    return (spread * (drawn[0] + BALANCE * drawn[1:])).exp()


def slopes_of(name: str, spread: float) -> tuple[float, float]:
    """By how much the log gain of that photograph grows to the right and down, from its middle to its sides, of that
    standard deviation."""
    right, down = (spread * torch.randn(2, generator=generator_of("shade", name)).double()).tolist()
    return right, down


def slopes_among(names: Sequence[str], spread: float) -> dict[str, tuple[float, float]]:
    """Slopes of these photographs less their mean, if they are several. Light that all photographs share looks like the
    scene's own, and no other photograph has it: it is nobody's to find."""
    drawn = {name: slopes_of(name, spread) for name in names}
    if len(names) < 2:
        return drawn
    right, down = (fmean(along) for along in zip(*(drawn[name] for name in names), strict=True))
    return {name: (across - right, along - down) for name, (across, along) in drawn.items()}


def turn_of(name: str, spread: float) -> tuple[float, float]:
    """Px to the right and down by which the middle of the picture of that photograph moves, of that standard
    deviation."""
    across, down = (spread * torch.randn(2, generator=generator_of("pose", name)).double()).tolist()
    return across, down


def movement_of(name: str, spread: float) -> tuple[float, float]:
    """Px to the right and down by which the camera's picture moved while that photograph was exposed, of that standard
    deviation."""
    across, down = (spread * torch.randn(2, generator=generator_of("blur", name)).double()).tolist()
    return across, down


def turned(camera: Camera, name: str, spread: float) -> Camera:
    """The camera turned about its centre, so that its picture moves so (`turn_of`)."""
    across, down = turn_of(name, spread)
    turn = about(0, -down / camera.fy) @ about(1, across / camera.fx)
    rotation, translation = (turn @ part.double() for part in (camera.rotation, camera.translation))
    return replace(camera, rotation=rotation.to(camera.rotation), translation=translation.to(camera.translation))


def about(axis: int, angle: float) -> Float[Tensor, "3 3"]:
    """Rotation about a coordinate axis, radians, float64."""
    one, other = (axis + 1) % 3, (axis + 2) % 3
    out = torch.eye(3, dtype=torch.float64)
    out[one, one] = out[other, other] = math.cos(angle)
    out[other, one] = math.sin(angle)
    out[one, other] = -math.sin(angle)
    return out


def patch_of(name: str, share: float) -> Patch:
    """A patch that covers that share of the photograph of that name, anywhere on it, in any colour."""
    generator, side = generator_of("covered", name), math.sqrt(share)
    left, top = ((1 - side) * torch.rand(2, generator=generator)).tolist()
    colour = torch.randint(0, 256, (3,), generator=generator, dtype=torch.uint8)
    return Patch(edges=(left, top, left + side, top + side), colour=colour)


def worse(view: View, by: Mapping[str, float], slopes: tuple[float, float] | None) -> View:
    """A view of a photograph that suffers all of it; a wrong pose is the view's, the photograph is as it was taken.
    slopes: of its light."""
    exposure, pose, covered, blur = (by.get(kind, 0.0) for kind in ("exposure", "pose", "covered", "blur"))
    kind = WorseFile if isinstance(view.source, FromFile) else Worse
    source = kind(
        source=as_taken(view),
        gains=gains_of(view.name, exposure) if exposure else None,
        slopes=slopes,
        patch=patch_of(view.name, covered) if covered else None,
        movement=view.camera.frame.shares(*movement_of(view.name, blur)) if blur else None,
    )
    return replace(view, source=source, camera=turned(view.camera, view.name, pose) if pose else view.camera)


# -- what a scene suffers ----------------------------------------------------------------------------------------------


def chosen(names: Sequence[str], share: float) -> set[str]:
    """That share of the photographs, at least one: the same in every run."""
    order = sorted(names, key=lambda name: derived_seed("disturbed some", name))
    return set(order[: max(1, round(share * len(order)))])


def disturbed(scene: Scene, by: Mapping[str, float]) -> Scene:
    """The scene with training photographs made worse, and a note that says so; test photographs stay as they are.

    by: `exposure`: standard deviation of log gains of display values, one a photograph; channels differ by a quarter.
    `shade`: of how much log gains grow from the middle of a photograph to its sides, to the right and down, less what
    photographs that suffer have in common.
    `pose`: of how far pictures move along each axis when cameras are turned, px. `blur`: of how far they move while
    they are exposed, px. `covered`: share of each photograph that something plain stands before. `some`: the share of
    photographs that suffer; 1 where it is not said.

    Raises:
        ConfigError: there is no such disturbance, or it is too large.
    """
    for kind, value in by.items():
        if kind not in MOST:
            raise ConfigError(f"scene.disturb.{kind}: photographs can be disturbed by {', '.join(MOST)}")
        if value > MOST[kind]:
            raise ConfigError(f"scene.disturb.{kind} is {value:g}; give at most {MOST[kind]:g}")
    asked = {kind: value for kind, value in by.items() if value and kind != "some"}
    some = by.get("some", 1.0)
    if not asked or not some:
        return scene
    names = chosen([view.name for view in scene.train], some)
    suffering = [view.name for view in scene.train if view.name in names]
    slopes = slopes_among(suffering, asked["shade"]) if "shade" in asked else {}
    told = ", ".join(f"{kind} {value:g}" for kind, value in asked.items())
    return replace(
        scene,
        train=[worse(view, asked, slopes.get(view.name)) if view.name in names else view for view in scene.train],
        notes=[
            *scene.notes,
            f"disturbed: {len(names)} of {len(scene.train)} training photographs (scene.disturb: {told})",
        ],
        provenance=scene.provenance | {"disturbed": asked | ({"some": some} if some < 1 else {})},
    )
