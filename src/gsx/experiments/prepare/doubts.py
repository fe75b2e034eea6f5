"""Doubts about a prepared scene: what programs ignore of it."""

from collections.abc import Iterator

from gsx.experiments.prepare.content import Prepared
from gsx.formats.origin import in_words

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
