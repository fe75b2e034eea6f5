"""Content of a prepared folder: views, their file names, and test views at each zoom; what programs ignore of it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from gsx.core.data.scene import Scene, View
from gsx.experiments.prepare.picture_names import Picture, pictures_of
from gsx.experiments.prepare.zoom_cameras import Zoomed, zoomed_views
from gsx.formats.origin import in_words


@dataclass(frozen=True, eq=False, kw_only=True)
class Prepared:
    """Content of a prepared folder."""

    scene: Scene
    train: list[Picture]
    test: list[Picture]
    zoomed: dict[float, Zoomed]
    """Test views by zoom and file name."""
    with_test: bool
    """True: `images/` holds test photos as well."""
    with_truth: bool
    """True: `truth/` holds test photos at each zoom."""

    @property
    def pictures(self) -> list[Picture]:
        """Pictures in `images/`."""
        return [*self.train, *self.test] if self.with_test else self.train

    @property
    def masked(self) -> bool:
        """Return whether a photo of the scene has a mask."""
        return "masks" in self.scene.provenance

    def work(self) -> float:
        """Return the sum of costs that `advance` will receive."""
        finer = [(view, factor) for factor, views in self.zoomed.items() for view in views.values()]
        return len(self.pictures) + sum(cost_of(view, factor) for view, factor in finer if self.with_truth)


def cost_of(view: View, factor: float) -> float:
    """Return the cost of a picture at a zoom: photos are decoded whole at any zoom, others rendered at that size."""
    return factor**2 if view.file is None else 1


def content_of(scene: Scene, zooms: Sequence[float], with_test: bool, with_truth: bool) -> Prepared:
    """Return the content of a scene's folder; InputError: a zoom has no truth."""
    sorts = str(scene.provenance.get("split", "")).startswith("every:")
    train, test = pictures_of(scene.train, scene.test, keep_order=sorts)
    return Prepared(
        scene=scene,
        train=train,
        test=test,
        zoomed=zoomed_views(test, zooms),
        with_test=with_test and bool(test),
        with_truth=with_truth and bool(test),
    )


CENTRE = 0.01
"""Distance of a principal point from the centre that no program shows in its pictures, px."""


def doubts_about(content: Prepared) -> Iterator[str]:
    """Yield one sentence for each."""
    cameras = [picture.camera for picture in [*content.train, *content.test]]
    off = max(max(abs(one.cx - one.width / 2), abs(one.cy - one.height / 2)) for one in cameras)
    if off > CENTRE:
        yield (
            f"principal points are up to {off:.2f} px off the centre: 3D-GS and OpenSplat ignore that, gsplat and "
            "nerfstudio do not; scene.principal_point=centred is the same for all programs"
        )
    if any(content.scene.origin):
        yield (
            f"the scene lies around {in_words(content.scene.origin)}, where single precision is too coarse: 3D-GS and "
            "OpenSplat lose detail there, and OpenSplat cannot read the doubles in points.ply"
        )
    if content.masked:
        yield "masks lie in masks/ and transforms.json: nerfstudio uses them, 3D-GS and OpenSplat do not"
    for factor, views in content.zoomed.items():
        if len(views) < len(content.test):
            yield f"zoom {factor:g} has {len(views)} of {len(content.test)} test views: the other photos are too small"
