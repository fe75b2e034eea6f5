"""TensorBoard's own reader finds what metrics.jsonl and evaluation.json hold."""

import json
import time
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.summary.writer.record_writer import RecordWriter
from tiny import StopAfter, tiny_run, tiny_settings

from gsx.builtin import plugins
from gsx.core.errors import TrainingError
from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run, start
from gsx.trackers.figures import evaluation_figures, line_figures
from gsx.trackers.tensorboard import events_folder

RUN = ("iterations=12", "scene.points=100", "scene.train_views=3", "training.checkpoint_every=4",
       "training.log_every=2", "tracker=[tensorboard]")  # fmt: skip


def read(folder: Path) -> EventAccumulator:
    """Everything in the event files of a folder."""
    return EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0, "tensors": 0}).Reload()


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def assert_curves_are_those_of_the_file(folder: Path) -> None:
    """Every number of every line, once, and nothing else."""
    events = read(folder / "tensorboard")
    curves = {tag: [(point.step, point.value) for point in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    expected: dict[str, list[tuple[int, float]]] = {}
    for line in lines(folder):
        for name, value in line_figures(line).items():
            expected.setdefault(name, []).append((line["step"], pytest.approx(value, rel=1e-6)))
    assert {tag: curve for tag, curve in curves.items() if not tag.startswith("evaluation/")} == expected


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tensorboard") / "run"
    pseudo = ("augmenter=[upscale]", "regenerator/upscale=lanczos", "augmenter.upscale.project=exact")
    tiny_run(folder, (*RUN, *pseudo, "eval.zoom=[1,2]"))
    return folder


def test_curves_are_those_of_the_file(finished: Path) -> None:
    assert_curves_are_those_of_the_file(finished)
    events = read(finished / "tensorboard")
    assert {"loss", "psnr", "test_psnr", "primitives", "seconds", "memory_mb", "terms/own", "terms/upscale"} <= set(
        events.Tags()["scalars"]
    )
    assert len(events.Scalars("test_psnr")) == 2


def test_the_evaluation_is_that_of_the_file(finished: Path) -> None:
    events = read(finished / "tensorboard")
    expected = evaluation_figures(json.loads((finished / "evaluation.json").read_text()))
    assert {"evaluation/psnr", "evaluation/x2/psnr"} <= expected.keys()
    found = {tag: events.Scalars(tag) for tag in events.Tags()["scalars"] if tag.startswith("evaluation/")}
    assert {tag: [(p.step, p.value) for p in points] for tag, points in found.items()} == {
        tag: [(12, pytest.approx(value, rel=1e-6))] for tag, value in expected.items()
    }


def test_pictures_and_the_configuration_are_there(finished: Path) -> None:
    events = read(finished / "tensorboard")
    names = [view["name"] for view in json.loads((finished / "evaluation.json").read_text())["views"]]
    crops = ("x2/enlarged", "x2/render", "x2/truth")
    expected = sorted(f"{name}/{kind}" for name in names for kind in ("render", "truth", *crops))
    assert sorted(tag for tag in events.Tags()["images"] if not tag.endswith("upscaled")) == expected  # by networks
    (picture,) = events.Images(expected[0])
    assert (picture.step, picture.width, picture.height) == (12, 48, 36)
    (text,) = events.Tensors("config/text_summary")
    assert "    iterations: 12\n" in text.tensor_proto.string_val[0].decode()
    (text,) = events.Tensors("zoom/text_summary")
    assert "\n| x2 | " in text.tensor_proto.string_val[0].decode()


@pytest.mark.parametrize("count", [0, 1])
def test_as_many_pictures_as_asked_for(count: int, tmp_path: Path) -> None:
    tiny_run(tmp_path / "run", ("iterations=1", "tracker=[tensorboard]", f"tracker.tensorboard.pictures={count}"))
    assert len(read(tmp_path / "run" / "tensorboard").Tags()["images"]) == 2 * count


def test_a_killed_run_goes_on_without_doubled_points(tmp_path: Path) -> None:
    # checkpoints at 4 and 8: what a kill at step 10 leaves are events later than the checkpoint
    folder = tmp_path / "run"
    tiny_run(folder, RUN, stop_after=10)
    for path in (folder / "checkpoints").glob("step_0000010.*"):
        path.unlink()
    assert read(folder / "tensorboard").Scalars("loss")[-1].step == 10
    run, settings = open_run(folder, plugins())
    assert run.step == 8
    execute(run, settings, plugins())
    assert_curves_are_those_of_the_file(folder)
    assert lines(folder)[-1]["step"] == 12


def test_lines_of_a_trunk_are_written_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    tiny_run(tmp_path / "first", (*RUN, "init=warm_start", "tracker=[]"), stop_after=7)
    tiny_run(tmp_path / "second", (*RUN, "init=warm_start"))
    assert (tmp_path / "second" / "branch.json").is_file()
    assert_curves_are_those_of_the_file(tmp_path / "second")
    assert lines(tmp_path / "second")[0]["step"] == 1


def test_lines_are_on_disk_when_they_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Look:
        """Reads at step 4, and hears of it after the tracker."""

        steps: list[int]

        @hookimpl(trylast=True)
        def gsx_step_finished(self, run: Run) -> None:
            if run.step == 4:
                Look.steps = [point.step for point in read(run.folder / "tensorboard").Scalars("loss")]

    def slow(writer: RecordWriter, data: bytes) -> None:
        time.sleep(0.02)  # another thread writes; it must be waited for
        write(writer, data)

    write = RecordWriter.write
    monkeypatch.setattr(RecordWriter, "write", slow)
    settings, loaded = tiny_settings(tmp_path / "run", *RUN), plugins()
    run = start(settings, loaded)
    with loaded.listening([Look(), StopAfter(5)]):
        execute(run, settings, loaded)
    assert Look.steps == [line["step"] for line in lines(tmp_path / "run") if line["step"] <= 4]


def test_why_a_run_failed_is_said(tmp_path: Path) -> None:
    class Raises:
        @hookimpl
        def gsx_step_finished(self, run: Run) -> None:
            if run.step == 3:
                raise TrainingError("three steps in a row")

    settings, loaded = tiny_settings(tmp_path / "run", *RUN), plugins()
    run = start(settings, loaded)
    with pytest.raises(TrainingError), loaded.listening([Raises()]):
        execute(run, settings, loaded)
    (text,) = read(tmp_path / "run" / "tensorboard").Tensors("failed/text_summary")
    assert (text.step, text.tensor_proto.string_val[0].decode()) == (3, "    three steps in a row\n")


def test_a_folder_of_ones_own_has_one_inside_for_each_run(tmp_path: Path) -> None:
    given = ("iterations=1", "tracker=[tensorboard]", f"tracker.tensorboard.folder={tmp_path / 'all'}")
    tiny_run(tmp_path / "outputs" / "demo" / "mine", (*given, f"output={tmp_path / 'outputs'}"))
    assert read(tmp_path / "all" / "demo" / "mine").Scalars("loss")
    run = tiny_run(tmp_path / "apart", (*given, f"output={tmp_path / 'outputs'}"))
    assert events_folder(run, str(tmp_path / "all")) == tmp_path / "all" / "apart"
    assert not (tmp_path / "apart" / "tensorboard").exists()


def test_a_folder_that_cannot_be_made_ends_no_run(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("no folder")
    tiny_run(tmp_path / "run", ("iterations=1", "tracker=[tensorboard]", f"tracker.tensorboard.folder={tmp_path}/file"))
    assert caplog.text.count("tracker tensorboard failed at step 0") == 1
    assert (tmp_path / "run" / "report.html").is_file()
