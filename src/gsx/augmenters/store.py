"""Files of pseudo views, kept while a checkpoint needs them."""

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.augmenters.pseudo_options import event_at
from gsx.core.data.camera import Camera, Frame
from gsx.core.data.reduction import Reduction
from gsx.core.errors import InputError
from gsx.core.files import replace_file, sidecars, step_of
from gsx.core.training.pseudo_views import PseudoView
from gsx.core.training.run import Run

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Store:
    """Pseudo views of one augmenter in a run folder, a file per event."""

    name: str
    iterations: int
    events: Sequence[int]
    span: int

    def write(self, run: Run, event: int, views: Sequence[PseudoView], facts: dict[str, Any]) -> None:
        """Writes the pseudo views of an event, and removes files that no checkpoint needs."""
        path = self.path(run, event)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_views(path, views, facts)
        self.forget(run, event)

    def path(self, run: Run, event: int) -> Path:
        """Returns the file of an event."""
        return run.folder / "pseudo" / f"{self.name}_{event:07d}.safetensors"

    def files(self, run: Run) -> list[Path]:
        """Returns the existing files, oldest first."""
        return sorted((run.folder / "pseudo").glob(f"{self.name}_{'[0-9]' * 7}.safetensors"))

    def forget(self, run: Run, event: int) -> None:
        """Removes files of past events without a checkpoint in their window."""
        steps = map(step_of, sidecars(run.folder / "checkpoints"))
        needed = {event} | {event_at(step + 1, self.events, self.span) for step in steps}
        kept = {self.path(run, number) for number in needed if number is not None}
        for path in self.files(run):
            if path not in kept:
                path.unlink()

    def recalled(self, run: Run, event: int) -> list[PseudoView]:
        """Reads the pseudo views that the run made before its interruption.

        A run that became longer has other events: where none of its events was at that step, it continues without
        pseudo views until the next one.
        """
        path = self.path(run, event)
        latest = [path] if path.is_file() else self.files(run)[-1:]
        try:
            if latest != [path] and latest and load_views(latest[0])[1]["iterations"] != self.iterations:
                self.log_longer(event)
                return []
            return load_views(path)[0]
        except (OSError, ValueError) as error:
            raise InputError(
                f"{path} cannot be read ({error}): the run needs the pseudo views of step {event} to continue at step "
                f"{run.step}; restore the file, or train anew"
            ) from error

    def log_longer(self, event: int) -> None:
        """Logs that a longer run continues without the pseudo views of an event."""
        if any(other > event for other in self.events):
            logger.info("%s: the run became longer, no pseudo views until the next event", self.name)
        else:
            logger.warning(
                "%s: the run became longer, and no later event makes pseudo views for its further steps; to have them, "
                "train anew",
                self.name,
            )


def picture_name(augmenter: str, view: PseudoView) -> str:
    """Returns the file name of a pseudo view's comparison picture."""
    known = view.provenance
    return f"{augmenter}_{known['event']:07d}_{view.parent}_x{known['scale']}_{known['kind']}.png"


def save_views(path: Path, views: Sequence[PseudoView], facts: dict[str, Any]) -> None:
    """Writes pseudo views and `facts` as one safetensors file, atomically."""
    from safetensors.torch import save

    tensors: dict[str, Tensor] = {}
    listed = []
    for number, view in enumerate(views):
        held = {"target": view.target, "rotation": view.camera.rotation, "translation": view.camera.translation}
        optional = {"trust": view.pixel_weight, "coarse": view.coarse}  # names that files have always had
        held |= {name: value for name, value in optional.items() if value is not None}
        tensors |= {
            f"{number}.{name}": value.clone(memory_format=torch.contiguous_format) for name, value in held.items()
        }
        entry = {name: getattr(view, name) for name in ("parent", "coarse_weight", "provenance")}
        numbers = {name: getattr(view.camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height", "near")}
        frame = view.camera.cut_from
        numbers["cut_from"] = None if frame is None else [frame.left, frame.top, frame.width, frame.height]
        listed.append(entry | {"camera": numbers, "reduction": asdict(view.reduction)})
    text = json.dumps({"facts": facts, "views": listed})
    replace_file(path, save(tensors or {"none": torch.zeros(0)}, metadata={"gsx": text}))


def load_views(path: Path) -> tuple[list[PseudoView], dict[str, Any]]:
    """Reads (views, facts) as `save_views` wrote them; ValueError: the file is damaged or another one."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            if (text := (file.metadata() or {}).get("gsx")) is None:
                raise ValueError("it has no pseudo views")
            content = json.loads(text)
            names = set(file.keys())
            tensors = {name: file.get_tensor(name) for name in names}
    except SafetensorError as error:
        raise ValueError(str(error)) from error
    views = []
    for number, entry in enumerate(content["views"]):
        values = dict(entry["camera"])
        if (frame := values.pop("cut_from")) is not None:
            values["cut_from"] = Frame(left=frame[0], top=frame[1], width=frame[2], height=frame[3])
        pose = {name: tensors[f"{number}.{name}"] for name in ("rotation", "translation")}
        view = PseudoView(
            camera=Camera(**pose, **values),
            target=tensors[f"{number}.target"],
            parent=entry["parent"],
            pixel_weight=tensors.get(f"{number}.trust"),
            coarse=tensors.get(f"{number}.coarse"),
            coarse_weight=entry["coarse_weight"],
            reduction=Reduction(**entry.get("reduction", {})),
            provenance=entry["provenance"],
        )
        views.append(view)
    return views, content["facts"]
