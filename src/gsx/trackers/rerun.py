"""Rerun: cameras, points, splats, renders and curves over the steps, in .rrd files in the run folder."""

import logging
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import View
from gsx.core.errors import GsxError
from gsx.core.files import write_json
from gsx.core.gaussians.sh import colour_of_constant
from gsx.core.gaussians.splats import Gaussians
from gsx.core.packages import require
from gsx.core.plugins import hookimpl
from gsx.core.ranges import Range
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.trackers.figures import (
    PictureCount,
    evaluation_figures,
    kept_state,
    line_figures,
    markdown,
    pictures,
    zoom_table,
)

logger = logging.getLogger(__name__)

FOLDER, STATE = "rerun", "rerun.json"
"""Folder in the run folder with a file for each start of training; file with Rerun's id and the last step in them."""
BANDS = 15
"""Harmonics of a splat besides the constant one in Rerun's format."""
FRUSTUM = 0.05
"""Length of drawn cameras, share of the scene's extent."""


@dataclass(frozen=True, kw_only=True)
class RerunOptions:
    """Options of the tracker; values in conf/tracker/rerun.yaml."""

    name: str
    snapshots: Annotated[int, Range(1, 10**6)]
    """Number of times, besides the start, that splats, cameras and renders are written, at equal intervals."""
    pictures: PictureCount


class Rerun:
    """Tracker that writes files for the Rerun viewer.

    Raises:
        ConfigError: rerun-sdk is not installed.
    """

    def __init__(self, options: RerunOptions) -> None:
        require("tracker rerun", ("rerun",), "gsx[rerun]")
        self.options = options
        self.record: Any = None
        self.recording = ""
        self.sent = -1

    @hookimpl
    def gsx_run_started(self, run: Run) -> None:
        """Opens a new file of this run's recording, with points and configuration."""
        import rerun

        state = kept_state(run.folder / STATE)
        self.recording, self.sent = state.get("recording", str(uuid.uuid4())), state.get("step", -1)
        folder = run.folder / FOLDER
        folder.mkdir(exist_ok=True)
        file = folder / f"{len(list(folder.glob('*.rrd'))):03d}.rrd"
        self.record = rerun.RecordingStream("gsx", recording_id=self.recording)
        self.record.save(file, default_blueprint=layout(run))
        self.record.send_recording_name(run.folder.name)
        points = rerun.Points3D(run.scene.points.positions.float().numpy(), colors=run.scene.points.colours.numpy())
        self.record.log("scene/points", points, static=True)
        config = (run.folder / "config.yaml").read_text(encoding="utf-8")
        self.record.log("config", rerun.TextDocument(config), static=True)
        self.send(run)
        logger.info("tracker rerun: %s", file)

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        """Writes new lines, and a snapshot when due."""
        self.send(run)

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        """Closes the file of an interrupted run."""
        if not run.complete:
            self.record.disconnect()

    @hookimpl
    def gsx_evaluated(self, run: Run, evaluation: dict[str, Any]) -> None:
        """Writes metrics, zoom table and pictures."""
        import rerun

        self.log_figures(evaluation_figures(evaluation), evaluation["step"])
        self.record.log("zoom", rerun.TextDocument(markdown(zoom_table(evaluation)), media_type="text/markdown"))
        images = pictures(run.folder / "renders", self.options.pictures)
        self.record.send_blueprint(layout(run, [*images]), make_active=False)
        for name, path in images.items():
            self.record.log(["pictures", *name.split("/")], rerun.EncodedImage(path=path))

    @hookimpl
    def gsx_run_finished(self) -> None:
        """Closes the file."""
        self.record.disconnect()

    @hookimpl
    def gsx_run_failed(self, run: Run, reason: str) -> None:
        """Writes the reason and closes the file."""
        import rerun

        self.record.set_time("step", sequence=run.step)
        self.record.log("failed", rerun.TextLog(reason))
        self.record.disconnect()

    def send(self, run: Run) -> None:
        """Writes what is new at a step; nothing at steps that are in an earlier file."""
        lines = [line for line in run.progress.curves if line["step"] > self.sent]
        due = run.step % max(1, run.iterations // self.options.snapshots) == 0 or run.complete
        if run.step <= self.sent or not (lines or due):
            return
        for line in lines:
            self.log_figures(line_figures(line), int(line["step"]))
        if due:
            self.log_snapshot(run)
        self.record.flush()
        self.sent = run.step
        write_json(run.folder / STATE, {"recording": self.recording, "step": self.sent})

    def log_figures(self, figures: dict[str, float], step: int) -> None:
        """Writes numbers of a step."""
        import rerun

        self.record.set_time("step", sequence=step)
        for name, value in figures.items():
            self.record.log(["figures", *name.split("/")], rerun.Scalars(value))

    def log_snapshot(self, run: Run) -> None:
        """Writes splats, cameras and renders as they are now; harmonics at the end alone, since they are large."""
        import rerun

        self.record.set_time("step", sequence=run.step)
        self.record.log("scene/splats", splats(gaussians_of(run), harmonics=run.complete))
        for kind, views in (("training", run.train_views), ("test", run.scene.test)):
            for view in views:
                self.record.log(["scene", kind, view.name], *camera_of(view, FRUSTUM * run.scene.extent))
        for view in run.scene.test[: self.options.pictures]:
            image = rerun.Image(to_uint8(render(run, view.camera).image).permute(1, 2, 0).numpy())
            self.record.log(["scene", "test", view.name], image.compress())


def layout(run: Run, names: Sequence[str] = ()) -> Any:
    """Arranges the scene, from where its first camera stands, pictures by name, curves and the zoom table."""
    from rerun import blueprint, new_entity_path

    camera = (*run.scene.test, *run.scene.train)[0].camera
    ahead = camera.centre + run.scene.extent * camera.rotation[2]
    eye = blueprint.EyeControls3D(position=camera.centre, look_target=ahead, eye_up=-camera.rotation[1])
    origins = {name: new_entity_path(["pictures", *name.split("/")]) for name in names}
    images = [blueprint.Spatial2DView(origin=origin, name=name) for name, origin in origins.items()]
    curves = [f"figures/{name}" for name in ("psnr", "test_psnr")]
    return blueprint.Blueprint(
        blueprint.Horizontal(
            blueprint.Tabs(
                blueprint.Spatial3DView(origin="scene", eye_controls=eye), blueprint.Grid(*images, name="pictures")
            ),
            blueprint.Vertical(
                blueprint.TimeSeriesView(origin="figures", contents=curves, name="PSNR, dB"),
                blueprint.TextDocumentView(origin="zoom"),
            ),
            column_shares=[2, 1],
        )
    )


def camera_of(view: View, length: float) -> tuple[Any, Any]:
    """Returns intrinsics, drawn as a frustum of a length, and pose of a view's camera."""
    import rerun

    camera: Camera = view.camera
    pinhole = rerun.Pinhole(
        focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx, camera.cy],
        resolution=camera.size,
        image_plane_distance=length,
    )
    return pinhole, rerun.Transform3D(translation=camera.centre, mat3x3=camera.rotation.T)


def gaussians_of(run: Run) -> Gaussians:
    """Returns all Gaussians, or where they depend on the camera those of the first one."""
    try:
        return run.backbone.explicit(None, run.model_step)
    except GsxError:
        return run.backbone.explicit((*run.scene.test, *run.scene.train)[0].camera, run.model_step)


def splats(gaussians: Gaussians, harmonics: bool) -> Any:
    """Converts Gaussians to Rerun's: standard deviations, quaternions (x, y, z, w), colours with opacity in 8 bits."""
    import rerun

    missing = gaussians.means.new_zeros(len(gaussians.means), BANDS - gaussians.sh_rest.shape[1], 3)
    colours = torch.cat([colour_of_constant(gaussians.sh_dc), gaussians.opacity_logits.sigmoid()[:, None]], 1)
    return rerun.GaussianSplats3D(
        numbers(gaussians.means),
        scales=numbers(gaussians.log_scales.exp()),
        quaternions=numbers(gaussians.quats.roll(-1, dims=1)),
        colors=numbers(to_uint8(colours)),
        sh_coefficients=numbers(torch.cat([gaussians.sh_rest, missing], 1)) if harmonics else None,
    )


def numbers(tensor: Tensor) -> Any:
    """Converts a tensor to NumPy."""
    return tensor.detach().cpu().numpy()
