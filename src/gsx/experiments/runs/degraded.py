"""Photos degraded in a known way, to measure modules that estimate and correct this (for research only)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import DerivedSource, ImageSource, Scene, View
from gsx.core.errors import ConfigError
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Float, UInt8
from gsx.modules.derived_views import fixed_source
from gsx.modules.motion_blur import motion_blurred

BALANCE = 0.25
"""Spread of the gain of one channel, as a share of that of the exposure."""
MOST = {"exposure": 2.0, "shade": 2.0, "pose": 64.0, "blur": 16.0, "covered": 0.9, "some": 1.0}
"""Largest value of each disturbance."""


def places_in_frame(camera: Camera) -> tuple[Float[Tensor, "W"], Float[Tensor, "H"]]:
    """Return centres of columns and of rows of pixels, as shares of the frame's sides."""
    frame = camera.frame
    columns = (torch.arange(camera.width) + 0.5 + frame.left) / frame.width
    return columns, (torch.arange(camera.height) + 0.5 + frame.top) / frame.height


@dataclass(frozen=True, eq=False, kw_only=True)
class Patch:
    """A rectangle of one colour in front of a camera."""

    edges: tuple[float, float, float, float]
    """Left, top, right, bottom, as shares of the frame's sides."""
    colour: UInt8[Tensor, "3"]

    def over(self, image: UInt8[Tensor, "3 H W"], camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Return the image with the patch over the pixels whose centres it covers."""
        (left, top, right, bottom), (x, y) = self.edges, places_in_frame(camera)
        covered = ((y >= top) & (y < bottom))[:, None] & ((x >= left) & (x < right))
        return torch.where(covered.to(image.device), self.colour.to(image.device)[:, None, None], image)


@dataclass(frozen=True, eq=False, kw_only=True)
class DegradedSource(DerivedSource):
    """A photo in other light, by a moving camera, with something in the way."""

    gains: Float[Tensor, "3"] | None = None
    """Factors of display values, which saturate."""
    slopes: tuple[float, float] | None = None
    """Slopes of log gains of display values, to the right and down, from the middle of the frame to its sides."""
    patch: Patch | None = None
    movement: tuple[float, float] | None = None
    """Movement across and down during the exposure, as shares of the frame's sides."""

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Return the degraded photo."""
        image = super().image(camera) if self.movement is None else blur(self.source, camera, *self.movement)
        if self.gains is not None or self.slopes is not None:
            light = self.light(camera).to(image.device)
            image = (image * light).round().clamp(0, 255).to(torch.uint8)
        return image if self.patch is None else self.patch.over(image, camera)

    def light(self, camera: Camera) -> Float[Tensor, "3 h w"]:
        """Return gains of display values: of each pixel, or of all alike (h = w = 1)."""
        gains = (torch.ones(3) if self.gains is None else self.gains)[:, None, None]
        if self.slopes is None:
            return gains
        (right, down), (x, y) = self.slopes, (2 * places - 1 for places in places_in_frame(camera))
        return gains * (right * x + down * y[:, None]).exp()


def blur(source: ImageSource, camera: Camera, across: float, down: float) -> UInt8[Tensor, "3 H W"]:
    """Return the photo of a camera that moves by these shares of the frame's sides; a crop is cut from the frame."""
    frame = camera.frame
    whole = source.image(camera.crop(-frame.left, -frame.top, frame.width, frame.height)).float()
    blurred = motion_blurred(whole, across * frame.width, down * frame.height).round().clamp(0, 255).to(torch.uint8)
    return blurred[:, frame.top : frame.top + camera.height, frame.left : frame.left + camera.width]


def generator_of(kind: str, name: str) -> torch.Generator:
    """Return the generator of one photo's numbers, which do not depend on the run's seed."""
    return torch.Generator().manual_seed(derived_seed(f"disturbed {kind}", name))


def gains_of(name: str, spread: float) -> Float[Tensor, "3"]:
    """Draw the gains of a photo by its name."""
    drawn = torch.randn(4, generator=generator_of("exposure", name))
    return (spread * (drawn[0] + BALANCE * drawn[1:])).exp()


def pair_of(kind: str, name: str, spread: float) -> tuple[float, float]:
    """Draw two numbers of this standard deviation by a photo's name: to the right, and down.

    kind: `shade`: slopes of log gains from the middle to the sides. `pose`: shift of the picture's middle, px. `blur`:
    movement of the picture during the exposure, px.
    """
    right, down = (spread * torch.randn(2, generator=generator_of(kind, name)).double()).tolist()
    return right, down


def slopes_among(names: Sequence[str], spread: float) -> dict[str, tuple[float, float]]:
    """Draw slopes of photos less their mean, if there are several: light that all share looks like the scene's."""
    drawn = {name: pair_of("shade", name, spread) for name in names}
    if len(names) < 2:
        return drawn
    right, down = (fmean(along) for along in zip(*(drawn[name] for name in names), strict=True))
    return {name: (across - right, along - down) for name, (across, along) in drawn.items()}


def turn(camera: Camera, name: str, spread: float) -> Camera:
    """Turn a camera about its centre, so that its picture moves by the photo's `pose` numbers."""
    across, down = pair_of("pose", name, spread)
    by = about(0, -down / camera.fy) @ about(1, across / camera.fx)
    rotation, translation = (by @ part.double() for part in (camera.rotation, camera.translation))
    return replace(camera, rotation=rotation.to(camera.rotation), translation=translation.to(camera.translation))


def about(axis: int, angle: float) -> Float[Tensor, "3 3"]:
    """Return the rotation about a coordinate axis, float64; `angle` in radians."""
    one, other = (axis + 1) % 3, (axis + 2) % 3
    out = torch.eye(3, dtype=torch.float64)
    out[one, one] = out[other, other] = math.cos(angle)
    out[other, one] = math.sin(angle)
    out[one, other] = -math.sin(angle)
    return out


def patch_of(name: str, share: float) -> Patch:
    """Draw a patch that covers this share of a photo, anywhere on it, in any colour."""
    generator, side = generator_of("covered", name), math.sqrt(share)
    left, top = ((1 - side) * torch.rand(2, generator=generator)).tolist()
    colour = torch.randint(0, 256, (3,), generator=generator, dtype=torch.uint8)
    return Patch(edges=(left, top, left + side, top + side), colour=colour)


def degrade_view(view: View, by: Mapping[str, float], slopes: tuple[float, float] | None) -> View:
    """Degrade one photo, with `slopes` of its light; a wrong pose changes the view's camera, not the photo."""
    exposure, pose, covered, moved = (by.get(kind, 0.0) for kind in ("exposure", "pose", "covered", "blur"))
    source = DegradedSource(
        source=fixed_source(view),
        gains=gains_of(view.name, exposure) if exposure else None,
        slopes=slopes,
        patch=patch_of(view.name, covered) if covered else None,
        movement=view.camera.frame.shares(*pair_of("blur", view.name, moved)) if moved else None,
    )
    return replace(view, source=source, camera=turn(view.camera, view.name, pose) if pose else view.camera)


def choose(names: Sequence[str], share: float) -> set[str]:
    """Choose this share of the photos, at least one; the choice does not depend on the run's seed."""
    order = sorted(names, key=lambda name: derived_seed("disturbed some", name))
    return set(order[: max(1, round(share * len(order)))])


def degrade(scene: Scene, by: Mapping[str, float]) -> Scene:
    """Degrade training photos and note it; test photos stay as they are.

    by: `exposure`: standard deviation of log gains of display values per photo; channels differ by a quarter. `shade`:
    that of the growth of log gains from the middle of a photo to its sides, less the mean over the photos. `pose`,
    `blur`: that of the shift of pictures by turned cameras, and of their movement during the exposure, px. `covered`:
    share of each photo behind a patch. `some`: share of photos to degrade (1).

    Raises:
        ConfigError: a disturbance is unknown or too large.
    """
    for kind, value in by.items():
        if kind not in MOST:
            raise ConfigError(f"Unknown disturbance scene.disturb.{kind}. Choose from {', '.join(MOST)}.")
        if value > MOST[kind]:
            raise ConfigError(f"scene.disturb.{kind} is {value:g}; give at most {MOST[kind]:g}")
    kinds = {kind: value for kind, value in by.items() if value and kind != "some"}
    some = by.get("some", 1.0)
    if not kinds or not some:
        return scene
    names = choose([view.name for view in scene.train], some)
    chosen = [view.name for view in scene.train if view.name in names]
    slopes = slopes_among(chosen, kinds["shade"]) if "shade" in kinds else {}
    train = [degrade_view(view, kinds, slopes.get(view.name)) if view.name in names else view for view in scene.train]
    listed = ", ".join(f"{kind} {value:g}" for kind, value in kinds.items())
    note = f"disturbed: {len(names)} of {len(scene.train)} training photographs (scene.disturb: {listed})"
    provenance = scene.provenance | {"disturbed": kinds | ({"some": some} if some < 1 else {})}
    return replace(scene, train=train, notes=[*scene.notes, note], provenance=provenance)
