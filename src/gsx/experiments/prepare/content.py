"""Content of a prepared folder: views, their file names, and test views at each zoom."""

from collections.abc import Sequence
from dataclasses import dataclass

from gsx.core.data.scene import Scene, View
from gsx.experiments.prepare.picture_names import Picture, pictures_of
from gsx.experiments.prepare.zoom_cameras import Zoomed, zoomed_views


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
