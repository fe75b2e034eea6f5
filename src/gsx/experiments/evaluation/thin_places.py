"""Thinly covered places of a scene, and where to photograph them from.

A part of a photo is thin where fewer than ENOUGH other training views show the same surface. For each photo the part
with most thin samples above half of it is a candidate; the largest candidates at different places are reported.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import View
from gsx.core.shapes import Float
from gsx.experiments.evaluation.chosen_views import neighbour
from gsx.experiments.evaluation.view_coverage import ENOUGH, Covered, SceneCoverage

PARTS = {
    "": (0.0, 0.0, 1.0, 1.0),
    "left half": (0.0, 0.0, 0.5, 1.0),
    "right half": (0.5, 0.0, 1.0, 1.0),
    "upper half": (0.0, 0.0, 1.0, 0.5),
    "lower half": (0.0, 0.5, 1.0, 1.0),
    "upper left": (0.0, 0.0, 0.5, 0.5),
    "upper right": (0.5, 0.0, 1.0, 0.5),
    "lower left": (0.0, 0.5, 0.5, 1.0),
    "lower right": (0.5, 0.5, 1.0, 1.0),
}
"""Parts of a photo: left, top, right and lower border as shares of its sides; the first is the whole."""
THIN = 0.5
"""Share of thin samples, of those with a surface, above which a part counts."""
LEAST = 0.05
"""Least excess of thin samples over THIN of a part, as a share of all samples of the photo."""
MOST_PLACES = 5
APART = 0.5
"""Least distance between two places, by the distance from which a photo shows the first."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Place:
    """Thinly covered place."""

    covered: Covered
    """Photo that shows it, with its samples."""
    held_out: bool
    """True: the photo is a test view."""
    part: str
    """Part of the photo (PARTS)."""
    share: float
    """Share of the samples with a surface in the part that are thin."""
    excess: float
    """Excess over THIN, as a share of the samples of the photo."""
    point: Float[Tensor, "3"]
    """Median of the thin points, world coordinates, float64."""

    @property
    def view(self) -> View:
        """Returns the photo."""
        return self.covered.sampled.view


@dataclass(frozen=True, eq=False, kw_only=True)
class Retake:
    """Photo to take."""

    place: Place
    neighbour: View | None
    """Training view on the other side of the place; None: there is none."""
    camera: Camera
    """Camera between both photos, or at the first, towards the place."""

    @property
    def words(self) -> str:
        """Returns where to stand, and where to look."""
        name, part = self.place.view.name, self.place.part
        if self.neighbour is None:
            return f"from near {name}, towards its {part}" if part else f"around {name}"
        between = f"between {name} and {self.neighbour.name}"
        return f"{between}, towards the {part} of {name}" if part else between

    @property
    def reason(self) -> str:
        """Returns the thin share of the part in words."""
        what = "that part" if self.place.part else "that photo"
        return f"fewer than {ENOUGH} other training photos show {self.place.share:.0%} of {what}"


def retakes_of(coverage: SceneCoverage) -> list[Retake]:
    """Returns the photos to take for the largest thin places, largest first."""
    train = [one.sampled.view for one in coverage.train]
    return [retake_of(place, train) for place in thin_places(coverage)]


def thin_places(coverage: SceneCoverage) -> list[Place]:
    """Returns up to MOST_PLACES thin places at different points, largest first."""
    found = [place_in(one, held_out=False) for one in coverage.train]
    found += [place_in(one, held_out=True) for one in coverage.test]
    candidates = [place for place in found if place is not None]
    chosen = list[Place]()
    for place in sorted(candidates, key=lambda one: -one.excess):
        if len(chosen) < MOST_PLACES and all(apart(place, other) for other in chosen):
            chosen.append(place)
    return chosen


def place_in(covered: Covered, held_out: bool) -> Place | None:
    """Returns the thin place of a photo; None: no part of it is thin."""
    solid = ~covered.sampled.empty
    thin = (covered.counts < ENOUGH) & solid
    if not len(thin):
        return None
    places, inside = covered.sampled.places, {}
    for part, borders in PARTS.items():
        low, high = places.new_tensor(borders[:2]), places.new_tensor(borders[2:])
        inside[part] = ((places >= low) & (places <= high)).all(1) & solid
    excess = {part: float((thin[rows].double() - THIN).sum()) / len(thin) for part, rows in inside.items()}
    part = max(excess, key=lambda name: excess[name])
    if excess[part] < LEAST:
        return None
    rows = inside[part]
    point = covered.sampled.points[rows & thin].median(0).values
    share = float(thin[rows].double().mean())
    return Place(covered=covered, held_out=held_out, part=part, share=share, excess=excess[part], point=point)


def apart(place: Place, other: Place) -> bool:
    """Returns whether a place differs from another that was chosen before."""
    reach = (other.point - other.view.camera.centre.double()).norm()
    return bool((place.point - other.point).norm() >= APART * reach)


def retake_of(place: Place, train: Sequence[View]) -> Retake:
    """Returns where to photograph a place from: half way to the next photo in its direction."""
    camera = place.view.camera
    centre, axis = camera.centre.double(), camera.rotation[2].double()
    way = place.point - centre
    offset = (way - axis * (way @ axis)) if place.part else torch.zeros_like(way)
    sides = {view.name: (view.camera.centre.double() - centre) @ offset for view in train}
    others = [view for view in train if view.name != place.view.name and sides[view.name] >= 0]
    index = neighbour(moved_to(camera, centre + offset / 2), [view.camera for view in others])
    other = None if index is None else others[index]
    eye = centre if other is None else (centre + other.camera.centre.double()) / 2
    return Retake(place=place, neighbour=other, camera=towards(camera, eye, place.point))


def moved_to(camera: Camera, centre: Float[Tensor, "3"]) -> Camera:
    """Returns the camera at another centre."""
    return replace(camera, translation=(-camera.rotation.double() @ centre).to(camera.translation))


def towards(camera: Camera, eye: Float[Tensor, "3"], point: Float[Tensor, "3"]) -> Camera:
    """Returns a camera at `eye` that looks at a point, with the lens and the upright of another."""
    up = -camera.rotation[1].double()
    try:
        turned = look_at(eye.tolist(), point.tolist(), up=up.tolist(), fov_x=1.0, width=camera.width, height=1)
    except ValueError:  # straight up or down
        return moved_to(camera, eye)
    rotation, translation = turned.rotation.to(camera.rotation), turned.translation.to(camera.translation)
    return replace(camera, rotation=rotation, translation=translation)
