"""Rerun's own reader finds what metrics.jsonl, evaluation.json and the splat file hold."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny import Raises, tiny_run, tiny_settings

from gsx.builtin import plugins
from gsx.core.errors import TrainingError
from gsx.core.training.run import Run
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run, start
from gsx.trackers.figures import evaluation_figures, line_figures

rerun = pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install '.[rerun]'")

RUN = ("iterations=6", "scene.points=100", "scene.train_views=3", "training.checkpoint_every=4",
       "training.log_every=2", "tracker=[rerun]", "tracker.rerun.snapshots=3")  # fmt: skip
Rows = dict[str, list[tuple[int, Any]]]


def rows(*files: Path) -> Rows:
    """(step, value) of each component that is not static, by `ENTITY:COMPONENT`."""
    from rerun.chunk import RrdReader

    found: Rows = {}
    for chunk in (chunk for file in files for chunk in RrdReader(file).stream().to_chunks()):
        batch = chunk.to_record_batch()
        steps = batch.column("step").cast("int64").to_pylist() if "step" in chunk.timeline_names else []
        for name in (name for name in batch.schema.names if ":" in name):
            values = batch.column(name).to_pylist()
            found.setdefault(f"{chunk.entity_path}:{name}", []).extend(zip(steps, values, strict=False))
    return {name: sorted(found[name], key=lambda row: row[0]) for name in found}


def files_of(folder: Path) -> list[Path]:
    return sorted((folder / "rerun").glob("*.rrd"))


def curves(found: Rows) -> dict[str, list[tuple[int, float]]]:
    """The points of each figure."""
    head, tail = "/figures/", ":Scalars:scalars"
    named = {name.removeprefix(head).removesuffix(tail): found[name] for name in found if name.endswith(tail)}
    return {name: [(step, value) for step, (value,) in points] for name, points in named.items()}


def expected_curves(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """What metrics.jsonl and evaluation.json hold."""
    expected: dict[str, list[tuple[int, float]]] = {}
    for line in map(json.loads, (folder / "metrics.jsonl").read_text().splitlines()):
        for name, value in line_figures(line).items():
            expected.setdefault(name, []).append((line["step"], value))
    evaluation = json.loads((folder / "evaluation.json").read_text())
    return expected | {name: [(evaluation["step"], value)] for name, value in evaluation_figures(evaluation).items()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("rerun") / "run"
    return tiny_run(folder, (*RUN, "eval.zoom=[1,2]", "tracker.rerun.pictures=1"))


@pytest.fixture(scope="module")
def found(finished: Run) -> Rows:
    return rows(*files_of(finished.folder))


def test_figures_are_those_of_the_files(finished: Run, found: Rows) -> None:
    assert curves(found) == expected_curves(finished.folder)
    assert "evaluation/x2/detail" in curves(found)


def test_splats_are_as_rerun_reads_the_splat_file(finished: Run, found: Rows, tmp_path: Path) -> None:
    with rerun.RecordingStream("gsx") as record:
        record.save(tmp_path / "ply.rrd")
        record.log_file_from_path(finished.folder / "point_cloud.ply")
    record.disconnect()
    from rerun.chunk import RrdReader

    columns = {
        name: batch.column(name).to_pylist()[0]
        for batch in (chunk.to_record_batch() for chunk in RrdReader(tmp_path / "ply.rrd").stream().to_chunks())
        for name in batch.schema.names
        if name.startswith("GaussianSplats3D:")
    }
    assert len(columns) == 5
    for name, expected in columns.items():
        step, values = found[f"/scene/splats:{name}"][-1]
        assert step == 6
        tolerance = {"rtol": 0, "atol": 0} if name.endswith("colors") else {"rtol": 2e-3, "atol": 2e-3}  # 16-bit
        np.testing.assert_allclose(np.array(values, float), np.array(expected, float), err_msg=name, **tolerance)


def test_splats_and_cameras_are_there_over_time(finished: Run, found: Rows) -> None:
    assert [step for step, _ in found["/scene/splats:GaussianSplats3D:centers"]] == [0, 2, 4, 6]
    view = finished.scene.test[0]
    (step, ((x, y, z),)), *_ = found[f"/scene/test/{view.name}:Transform3D:translation"]
    assert step == 0
    assert (x, y, z) == pytest.approx(view.camera.centre.tolist(), abs=1e-6)
    _, (matrix,) = found[f"/scene/test/{view.name}:Transform3D:mat3x3"][0]
    assert np.allclose(np.reshape(matrix, (3, 3)), view.camera.rotation)  # columns first: world from camera
    _, (matrix,) = found[f"/scene/test/{view.name}:Pinhole:image_from_camera"][0]
    camera = view.camera
    intrinsics = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    assert np.allclose(np.reshape(matrix, (3, 3)).T, intrinsics)
    assert sum(name.startswith("/scene/training/") and name.endswith(":translation") for name in found) == 3


def test_renders_zoom_table_and_crops_are_there(finished: Run, found: Rows) -> None:
    name = finished.scene.test[0].name
    assert [step for step, _ in found[f"/scene/test/{name}:EncodedImage:blob"]] == [0, 2, 4, 6]
    (step, (text,)) = found["/zoom:TextDocument:text"][0]
    assert (step, "\n| x2 | " in text) == (6, True)
    for kind in ("render", "truth", "x2/render", "x2/enlarged", "x2/truth"):
        assert f"/pictures/{name}/{kind}:EncodedImage:blob" in found


def test_a_run_that_goes_on_writes_the_same_recording_without_doubled_points(tmp_path: Path) -> None:
    # the checkpoint of step 4: what a kill at step 5 leaves is a point later than that
    folder = tmp_path / "run"
    tiny_run(folder, (*RUN, "training.log_every=1"), stop_after=5)
    for path in (folder / "checkpoints").glob("step_0000005.*"):
        path.unlink()
    run, settings = open_run(folder, plugins())
    assert run.step == 4
    execute(run, settings, plugins())
    assert len(files_of(folder)) == 2
    assert len({recording(file) for file in files_of(folder)}) == 1
    together, expected = rows(*files_of(folder)), expected_curves(folder)
    timed = {"seconds", "memory_mb"}  # of the first time for the step that was repeated
    assert {name: curve for name, curve in curves(together).items() if name not in timed} == {
        name: curve for name, curve in expected.items() if name not in timed
    }
    assert [step for step, _ in together["/scene/splats:GaussianSplats3D:centers"]] == [0, 2, 4, 6]


def recording(file: Path) -> str:
    from rerun.chunk import RrdReader

    (entry,) = RrdReader(file).recordings()
    return str(entry.recording_id)


def test_why_a_run_failed_is_there_and_splats_of_a_camera(tmp_path: Path) -> None:
    """Splats of anchors depend on the camera."""
    settings, loaded = tiny_settings(tmp_path / "run", *RUN, "backbone=scaffold"), plugins()
    run = start(settings, loaded)
    with pytest.raises(TrainingError), loaded.listening([Raises(TrainingError("not finite"))]):
        execute(run, settings, loaded)
    found = rows(*files_of(tmp_path / "run"))
    assert found["/failed:TextLog:text"] == [(3, ["not finite"])]
    assert [step for step, _ in found["/scene/splats:GaussianSplats3D:centers"]] == [0, 2]
