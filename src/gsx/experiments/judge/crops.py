"""The same window of each method's picture, next to the truth."""

from pathlib import Path
from typing import Any

from gsx.core.data.images import write_image
from gsx.core.data.scene import Scene, View
from gsx.core.data.window import Window
from gsx.core.quality.metrics import psnr
from gsx.experiments.evaluation.chosen_views import evenly
from gsx.experiments.evaluation.zoomed import Zoomed
from gsx.experiments.judge.methods import Method
from gsx.experiments.reports.pictures import WINDOW, file_names, most_detailed

VIEWS = 3
"""Test views of a scene whose crops are written."""


class Crops:
    """Crops of some test views at each zoom, written as they come: where the truth has most detail."""

    def __init__(self, folder: Path, scene: Scene, stem: str) -> None:
        """Chooses the views; `stem` begins the names of files in the folder."""
        self.folder, self.stem = folder, stem
        chosen = evenly(scene.test, VIEWS)
        names = file_names([view.name for view in chosen])
        self.names = {view.name: name for view, name in zip(chosen, names, strict=True)}
        self.rows: dict[tuple[str, float], dict[str, Any]] = {}

    def receive(self, method: Method, view: View, zoomed: Zoomed) -> None:
        """Writes the crop of a picture, and of its truth at the first of them."""
        if view.name not in self.names:
            return
        row = self.row(view, zoomed)
        window = Window(*row["window"])
        inside = None if zoomed.counted is None else window.cut(zoomed.counted[None])[0]
        if inside is not None and not inside.any():
            return
        crop, truth = window.cut(zoomed.render), window.cut(zoomed.truth)
        file = f"{self.stem}.{self.names[view.name]}.x{zoomed.factor:g}.{len(row['shots'])}.png"
        write_image(self.folder / file, crop)
        shot = {"method": method.entry.name, "repetition": method.entry.repetition, "file": file}
        row["shots"].append(shot | {"psnr": psnr(crop, truth, inside)})

    def row(self, view: View, zoomed: Zoomed) -> dict[str, Any]:
        """Returns the row of a view at a zoom, with its window and the file of the truth."""
        key = view.name, zoomed.factor
        if key not in self.rows:
            window = most_detailed(zoomed.truth, WINDOW, zoomed.counted)
            file = f"{self.stem}.{self.names[view.name]}.x{zoomed.factor:g}.truth.png"
            write_image(self.folder / file, window.cut(zoomed.truth))
            place = [window.left, window.top, window.width, window.height]
            self.rows[key] = {"view": view.name, "factor": zoomed.factor, "window": place, "truth": file, "shots": []}
        return self.rows[key]

    def index(self) -> list[dict[str, Any]]:
        """Returns the rows of crops."""
        return [row for row in self.rows.values() if row["shots"]]
