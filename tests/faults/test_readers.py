"""Readers of damaged files: each case gives something sound, or one sentence, in bounded memory."""

import base64
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from foreign_gltf import Builder, glb
from foreign_splats import files_of, header, row, section, splat, unpacked, version_1, version_2, whole, zipped
from synthetic_colmap import synthesize, write_photos, write_scene
from tiny import tiny_run

from faults.mutations import mutated
from faults.record import record, shorter, some
from gsx.builtin import plugins
from gsx.core.data.images import read_image, write_image
from gsx.core.data.scene import Scene
from gsx.core.errors import GsxError
from gsx.core.gaussians.splats import Gaussians
from gsx.experiments.reports.report import write_report
from gsx.experiments.run_folder import checkpoint
from gsx.experiments.run_folder.files import read_run, state_of
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.inspect import describe
from gsx.experiments.runs.open import open_run
from gsx.formats.ply import read_ply, write_ply
from gsx.formats.splat_files import SpzForm, compensated, read_gaussians, write_gaussians

pytestmark = pytest.mark.faults

PARTS = 2
PURE, NATIVE, SLOW = 100_000, 1_000, 1_000
"""Cases of readers in Python, of those that call native libraries, and of whole commands."""
MEMORY, SECONDS = 6 << 30, 20
"""What a case may take."""


@dataclass(frozen=True)
class Reader:
    """What is read, and how."""

    prepare: Callable[[Path], list[Path]]
    """Makes a sound example in a folder; returns the files that are damaged, one at a time."""
    read: Callable[[Path], None]
    """Reads that folder; fails with an AssertionError where something unsound comes out."""
    cases: int
    settle: Callable[[Path], None] = lambda _: None
    """Makes a damaged file's digest right again, where one guards it."""


def example_run(folder: Path) -> None:
    """A finished run of two steps."""
    tiny_run(folder / "run", ["iterations=2", "training.log_every=1", "rasterizer=eager"])


def run_files(folder: Path) -> list[Path]:
    example_run(folder)
    names = ("config.yaml", "environment.json", "status.json", "metrics.jsonl", "evaluation.json", "renders/index.json")
    return [folder / "run" / name for name in names]


def json_files(folder: Path) -> list[Path]:
    """The same beside a configuration that is read at once: YAML takes most of the time."""
    files = run_files(folder)
    files[0].write_text("iterations: 2\nscene: {name: demo}\nbackbone: {name: gs3d}\naugmenter: {}\n")
    return files[1:]


def checkpoint_files(folder: Path) -> list[Path]:
    example_run(folder)
    sidecar = checkpoint.sidecars(folder / "run" / "checkpoints")[-1]
    return [sidecar, sidecar.with_suffix(".safetensors")]


def settle_checkpoint(folder: Path) -> None:
    """The sidecar tells the digest of what is there."""
    sidecar = checkpoint.sidecars(folder / "run" / "checkpoints")[-1]
    digest = hashlib.sha256(sidecar.with_suffix(".safetensors").read_bytes()).hexdigest()
    with suppress(ValueError, TypeError, RecursionError):
        meta = json.loads(sidecar.read_text(errors="strict"))
        if isinstance(meta, dict) and "sha256" in meta:
            sidecar.write_text(json.dumps(meta | {"sha256": digest}))


def read_checkpoint(folder: Path) -> None:
    checkpoint.newest(folder / "run" / "checkpoints")


def restore(folder: Path) -> None:
    run, _ = open_run(folder / "run", plugins())
    assert run.step >= 0


def read_state(folder: Path) -> None:
    assert state_of(read_run(folder / "run"))[0]


def report(folder: Path) -> None:
    write_report(folder / "run")


def scene_files(kind: str) -> Callable[[Path], list[Path]]:
    """A scene of five photographs, in the given format."""

    def prepare(folder: Path) -> list[Path]:
        made = synthesize()
        if kind in ("bin", "txt"):
            model = write_scene(made, folder, text=kind == "txt")
            return sorted(path for path in model.iterdir() if path.suffix == f".{kind}")
        write_photos(made, folder / "images")
        frames = [
            {"file_path": f"images/{image.name}", "transform_matrix": opengl(image).tolist()}
            for image in made.images.values()
        ]
        content = {"w": 64, "h": 48, "fl_x": 80.0, "fl_y": 82.0, "cx": 30.0, "cy": 25.0, "frames": frames}
        if kind == "lenses":
            fisheye = content | {"camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k4": 0.0, "test_frames": frames[3:]}
            frames[0] |= {"fl_x": 85.0, "k2": 0.01, "is_fisheye": True, "mask_path": frames[0]["file_path"]}
            contents = {"transforms.json": fisheye | {"frames": frames[:3], "rolling_shutter": [0, 0, 0, 0]}}
        elif kind == "pair":
            halves = {"transforms_train.json": frames[:3], "transforms_val.json": frames[3:]}
            contents = {name: content | {"frames": half} for name, half in halves.items()}
        elif kind == "transforms":
            contents = {"transforms.json": content | {"k1": 0.01, "camera_model": "OPENCV"}}
        else:
            halves = {"transforms_train.json": frames[:3], "transforms_test.json": frames[3:]}
            contents = {name: {"camera_angle_x": 0.76, "frames": half} for name, half in halves.items()}
        for name, written in contents.items():
            (folder / name).write_text(json.dumps(written))
        return [folder / name for name in contents]

    return prepare


def opengl(image) -> np.ndarray:
    """Camera to world with y up and z back."""
    matrix = np.eye(4)
    matrix[:3] = image.cam_from_world().inverse().matrix()
    return matrix @ np.diag([1.0, -1.0, -1.0, 1.0])


OPTIONS: dict[str, object] = {}
"""Settings by kind of scene, composed once."""


def load(kind: str) -> Callable[[Path], None]:
    """Loads the scene and looks whether its cameras and points can be trained on."""

    def read(folder: Path) -> None:
        if kind not in OPTIONS:
            OPTIONS[kind] = compose([f"scene={kind}", f"scene.path={folder}"], plugins()).scene
        chosen = OPTIONS[kind]
        sound(chosen.component.factory(replace(chosen.options, path=str(folder))))  # type: ignore[attr-defined]

    return read


def sound(scene: Scene) -> None:
    """Finite cameras of positive focal length and size, finite points, no view in both halves."""
    assert len(scene.train) >= 2
    assert len(scene.points.positions)
    assert bool(torch.isfinite(scene.points.positions).all())
    for view in (*scene.train, *scene.test):
        camera = view.camera
        values = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy])
        assert bool(torch.isfinite(values).all()), view.name
        assert min(camera.fx, camera.fy, *camera.size) > 0, view.name
        assert bool(torch.isfinite(camera.rotation).all() and torch.isfinite(camera.translation).all()), view.name
    assert not {view.name for view in scene.train} & {view.name for view in scene.test}


def cloud(folder: Path) -> list[Path]:
    write_ply(folder / "points.ply", {name: np.arange(20, dtype=np.float32) for name in ("x", "y", "z")})
    text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty uchar red\nend_header\n1.5 3\n2 4\n"
    (folder / "text.ply").write_text(text)
    return [folder / "points.ply", folder / "text.ply"]


def read_clouds(folder: Path) -> None:
    for name in ("points.ply", "text.ply"):
        columns = read_ply(folder / name)
        assert len({len(column) for column in columns.values()}) == 1


def splats(folder: Path) -> list[Path]:
    example_run(folder)
    return [folder / "run" / "point_cloud.ply"]


def read_splats(folder: Path) -> None:
    read_gaussians(folder / "run" / "point_cloud.ply")


COMPACT = ("a.compressed.ply", "a.spz", "a.sog", "a.glb", "of_version_4.spz")
FOREIGN = ("a.splat", "a.ksplat", "floats.ksplat", "sog/meta.json", "sog/means_l.webp", "sog/quats.webp", "one.sog")
"""Splat files that gsx reads alone."""


def compact(folder: Path) -> list[Path]:
    values = torch.rand(30, 3, generator=torch.Generator().manual_seed(0))
    made = Gaussians(means=values, log_scales=values - 4, quats=values[:, [0, 1, 2, 0]], opacity_logits=values[:, 0],
                     sh_dc=values, sh_rest=values[:, None].repeat(1, 3, 1))  # fmt: skip
    for name in COMPACT:
        write_gaussians(folder / name, made, spz=SpzForm(version=4 if "4" in name else 3))
    return [folder / name for name in COMPACT]


def read_compact(folder: Path) -> None:
    for name in COMPACT:
        read = read_gaussians(folder / name)
        assert len({len(column) for column in vars(read).values()}) == 1
        assert all(bool(torch.isfinite(column).all()) for column in vars(read).values()), name


def foreign(folder: Path) -> list[Path]:
    (folder / "a.splat").write_bytes(splat() * 3)
    (folder / "a.ksplat").write_bytes(whole())
    (folder / "floats.ksplat").write_bytes(header(1, 1, 0) + section(1, 1) + row(0, (1, 2, 3), range(9)))
    unpacked(folder / "sog", files_of(version_2()))
    zipped(folder / "one.sog", files_of(version_1()))
    return [folder / name for name in FOREIGN]


def read_foreign(folder: Path) -> None:
    for name in ("a.splat", "a.ksplat", "floats.ksplat", "sog", "one.sog"):
        read = read_gaussians(folder / name)
        assert len({len(column) for column in vars(read).values()}) == 1
        assert all(bool(torch.isfinite(column).all()) for column in vars(read).values()), name
        compensated(folder / name)


OTHERS = ("faces.ply", "text.ply", "a.glb", "a.gltf")
"""Splat files as other programs write them."""


def others(folder: Path) -> list[Path]:
    names = [*"xyz", "red", "green", "blue", "alpha", "scale_0", "scale_1", "scale_2", *(f"rot_{i}" for i in range(4))]
    head = "element face 2\nproperty list uchar int corners\nelement vertex 2\n"
    head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    values = struct.pack(">28f", *[0.5] * 28)
    faces = struct.pack(">BiiiBi", 3, 0, 1, 0, 1, 1)
    (folder / "faces.ply").write_bytes(f"ply\nformat binary_big_endian 1.0\n{head}".encode() + faces + values)
    rows = "3 0 1 0\n1 1\n" + 2 * (14 * "0.5 " + "\n")
    (folder / "text.ply").write_text(f"ply\nformat ascii 1.0\n{head}{rows}")
    builder = Builder()
    values = torch.rand(4, 3, generator=torch.Generator().manual_seed(0))
    made = Gaussians(means=values, log_scales=values - 4, quats=values[:, [0, 1, 2, 0]], opacity_logits=values[:, 0],
                     sh_dc=values, sh_rest=values[:, None].repeat(1, 3, 1))  # fmt: skip
    primitive = builder.splats(made, colorSpace="lin_rec709_display")
    indices, replacing = builder.view(b"\1"), builder.view(bytes(12))
    builder.accessors[0]["sparse"] = {"count": 1, "indices": {"bufferView": indices, "componentType": 5121},
                                      "values": {"bufferView": replacing}}  # fmt: skip
    nodes = [{"rotation": [0.1, 0.2, 0.3, 0.9], "children": [1]}, {"mesh": 0, "scale": [1, 2, 3]}]
    document = builder.document([[primitive]], nodes)
    (folder / "a.glb").write_bytes(glb(document, builder.body))
    document["buffers"][0]["uri"] = "data:;base64," + base64.b64encode(builder.body).decode()
    (folder / "a.gltf").write_text(json.dumps(document))
    return [folder / name for name in OTHERS]


def read_others(folder: Path) -> None:
    for name in OTHERS:
        read = read_gaussians(folder / name)
        assert len({len(column) for column in vars(read).values()}) == 1
        assert all(bool(torch.isfinite(column).all()) for column in vars(read).values()), name
        compensated(folder / name)


def images(folder: Path) -> list[Path]:
    picture = torch.rand(3, 20, 30, generator=torch.Generator().manual_seed(0))
    for suffix in ("png", "jpg"):
        write_image(folder / f"photo.{suffix}", picture)
    return [folder / f"photo.{suffix}" for suffix in ("png", "jpg")]


def read_images(folder: Path) -> None:
    for path in sorted(folder.glob("photo.*")):
        assert read_image(path).ndim == 3


def describe_folder(folder: Path) -> None:
    assert "".join(describe(folder, plugins()))


READERS = {
    "PLY": Reader(cloud, read_clouds, PURE),
    "splat file": Reader(splats, read_splats, PURE),
    "compact splat file": Reader(compact, read_compact, PURE // 10),
    "splat file of another program": Reader(others, read_others, PURE // 10),
    "splat file of a viewer": Reader(foreign, read_foreign, PURE // 10),
    "transforms.json": Reader(scene_files("transforms"), load("transforms"), PURE),
    "transforms.json of fisheyes": Reader(scene_files("lenses"), load("transforms"), NATIVE * 5),
    "transforms to train and test on": Reader(scene_files("pair"), load("transforms"), NATIVE * 5),
    "transforms of NeRF-synthetic": Reader(scene_files("blender"), load("blender"), PURE),
    "COLMAP binary": Reader(scene_files("bin"), load("colmap"), NATIVE * 5),
    "COLMAP text": Reader(scene_files("txt"), load("colmap"), NATIVE * 5),
    "a COLMAP folder, described": Reader(scene_files("bin"), describe_folder, NATIVE),
    "images": Reader(images, read_images, NATIVE * 5),
    "checkpoint": Reader(checkpoint_files, read_checkpoint, PURE),
    "checkpoint of the right digest": Reader(checkpoint_files, read_checkpoint, PURE, settle_checkpoint),
    "checkpoint of the right digest, restored": Reader(checkpoint_files, restore, SLOW, settle_checkpoint),
    "files of a run": Reader(run_files, read_state, PURE // 10),
    "JSON files of a run": Reader(json_files, read_state, PURE),
    "files of a run, reported": Reader(run_files, report, SLOW),
    "files of a run, opened": Reader(run_files, restore, SLOW),
}
"""By what is read."""


def problem_of(read: Callable[[Path], None], folder: Path) -> str:
    """What is wrong with how a damaged folder is read; empty: nothing."""
    try:
        read(folder)
    except GsxError as error:
        text = str(error)
        return "" if text and "\n" not in text else f"no sentence: {text[:200]!r}"
    except AssertionError as error:
        return f"unsound: {error!r}"
    except BaseException as error:
        return repr(error)[:200]
    return ""


def child(reader: Reader, folder: Path, files: list[Path], numbers: range, told: Path) -> None:
    """Cases one after the other; what is wrong is appended to a file, the number of each case before it is tried."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    whole = {path: path.read_bytes() for path in files}
    with told.open("w") as out:
        for number in numbers:
            choice = random.Random(number)
            path = choice.choice(files)
            path.write_bytes(mutated(whole[path], choice))
            reader.settle(folder)
            out.write(f"{number} {path.name}: ")
            out.flush()
            signal.alarm(SECONDS)
            out.write(f"{problem_of(reader.read, folder)}\n")
            signal.alarm(0)
            for file, content in whole.items():
                file.write_bytes(content)


def tried(reader: Reader, folder: Path, files: list[Path], numbers: range) -> list[str]:
    """Problems of some cases, in a process of their own."""
    told = folder.parent / "told.txt"
    pid = os.fork()
    if pid == 0:
        try:
            child(reader, folder, files, numbers, told)
        finally:
            os._exit(0)
    _, status = os.waitpid(pid, 0)
    lines = told.read_text().splitlines()
    wrong = [line for line in lines if line.partition(": ")[2]]
    if os.waitstatus_to_exitcode(status) != 0 or len(lines) < len(numbers):
        wrong.append(f"{lines[-1] if lines else numbers[0]} ended the process ({os.waitstatus_to_exitcode(status)})")
    return wrong


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("name", READERS)
def test_damaged_files(tmp_path: Path, name: str, part: int) -> None:
    reader, wrong = READERS[name], []
    folder = tmp_path / "folder"
    folder.mkdir()
    files = reader.prepare(folder)
    assert problem_of(reader.read, folder) == "", "it must be sound before it is damaged"
    with record(f"a damaged file: {name}", part, seed=part) as counts:
        share, step = reader.cases // PARTS, max(10, int(shorter(500)))
        for first in some(range(part * share, (part + 1) * share, step)):
            numbers = range(first, min(first + step, (part + 1) * share))
            wrong += tried(reader, folder, files, numbers)
            counts.cases += len(numbers)
            if len(wrong) > 50:
                break
        assert not wrong, "\n".join(wrong)
    shutil.rmtree(folder)
