"""Pictures of pseudo views for the report: before and after redrawing, and as the trained model renders them."""

import logging
from pathlib import Path
from typing import Any

from gsx.augmenters.store import load_views, picture_name
from gsx.core.data.images import write_image
from gsx.core.files import write_json
from gsx.core.training.pseudo_views import PseudoView
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.evaluation.eval_options import EvalOptions

logger = logging.getLogger(__name__)

MOST_VIEWS = 6
"""Pseudo views of each augmenter in the report."""


def write_pseudo_pictures(run: Run, options: EvalOptions) -> None:
    """Render pseudo views of the last events that have pictures by augmenters, and write their index."""
    folder = run.folder / "pseudo"
    entries: list[dict[str, Any]] = []
    latest = {path.stem.rpartition("_")[0]: path for path in sorted(folder.glob("*.safetensors"))}
    for augmenter, path in latest.items():
        try:
            views, _ = load_views(path)
        except (OSError, ValueError) as error:
            logger.warning("%s cannot be read (%s): the report omits its pseudo views", path, error)
            continue
        pictured = with_pictures(folder, augmenter, views)[:MOST_VIEWS]
        entries += [picture_entry(run, options, augmenter, view) for view in pictured]
    if entries:
        write_json(folder / "index.json", {"views": entries})


def with_pictures(folder: Path, augmenter: str, views: list[PseudoView]) -> list[PseudoView]:
    """Return one view for each existing picture."""
    complete = [view for view in views if {"event", "scale", "kind"} <= view.provenance.keys()]
    by_name = {picture_name(augmenter, view): view for view in complete}
    return [view for name, view in by_name.items() if (folder / name).is_file()]


def picture_entry(run: Run, options: EvalOptions, augmenter: str, view: PseudoView) -> dict[str, Any]:
    """Render one pseudo view; return its entry in the index."""
    after = render(run, view.camera, options.tile_pixels).image
    made = picture_name(augmenter, view)
    name = made.replace(".png", "_after.png")
    write_image(run.folder / "pseudo" / name, after)
    return {"augmenter": augmenter, "made": made, "after": name, **view.provenance}
