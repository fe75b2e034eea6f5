"""gsx judge: figures against float64 and gsx eval, layouts of programs, and refusals that leave nothing behind."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from judging import QUICK, Subject, judged, made_subject, noisy, write_method

from gsx.cli.dispatch import main
from gsx.core.data.images import read_image, write_image
from gsx.core.files import read_json
from gsx.core.gaussians.sh import constant_from_colour
from gsx.core.gaussians.splats import Gaussians
from gsx.formats.splat_files import write_gaussians


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Subject:
    return made_subject(tmp_path_factory.mktemp("judged") / "scene")


@pytest.fixture(scope="module")
def pictures(subject: Subject, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_method(subject, tmp_path_factory.mktemp("pictures") / "noisy")


def exact_psnr(image: torch.Tensor, truth: torch.Tensor) -> float:
    """PSNR of 8-bit pictures in float64."""
    squares = (image.double().numpy() - truth.double().numpy()) ** 2 / 255**2
    return float(-10 * np.log10(squares.mean()))


def splats(subject: Subject) -> Gaussians:
    """Large grey splats at the points of the scene."""
    means = subject.scene.points.positions.float()
    count = len(means)
    return Gaussians(
        means=means,
        log_scales=torch.full((count, 3), -1.5),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        opacity_logits=torch.full((count,), 2.0),
        sh_dc=constant_from_colour(torch.rand(count, 3, generator=torch.Generator().manual_seed(0))),
        sh_rest=torch.zeros(count, 0, 3),
    )


# -- figures -----------------------------------------------------------------------------------------------------------


def test_figures_are_those_of_float64(subject: Subject, pictures: Path, tmp_path: Path) -> None:
    content = judged(tmp_path / "out", f"noisy={pictures}", *subject.words)
    (method,) = content["results"][0]["methods"]
    for factor in (1, 2):
        expected = [
            exact_psnr(read_image(pictures / f"x{factor}" / f"{Path(view.name).stem}.png"), truth)
            for view, truth in subject.truths(factor)
        ]
        found = [view["zoom"][str(factor)]["psnr"] for view in method["views"].values()]
        assert found == pytest.approx(expected, abs=1e-6)
        assert method["zoom"][str(factor)]["psnr"] == pytest.approx(np.mean(expected), abs=1e-6)
    with (tmp_path / "out" / "views.csv").open() as stream:
        assert len(list(csv.DictReader(stream))) == 2 * len(subject.scene.test)
    assert {"comparison.html", "comparison.json", "figures.csv", "views.csv", "pictures"} == {
        path.name for path in (tmp_path / "out").iterdir()
    }


def test_a_splat_file_has_the_figures_of_gsx_eval(subject: Subject, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "model.ply", splats(subject))
    more = ["scene.split=every:2", "eval.zoom=[1,2]", "rasterizer=eager", "eval.flight=false"]
    words = ["scene=colmap", f"scene.path={subject.folder}", *subject.words[1:], *more]
    assert main(["eval", str(tmp_path / "model.ply"), *words, f"folder={tmp_path / 'run'}"]) == 0
    expected = read_json(tmp_path / "run" / "evaluation.json")["zoom"]
    methods = [f"file={tmp_path / 'model.ply'}", f"run={tmp_path / 'run'}"]
    for method in judged(tmp_path / "out", *methods, *words)["results"][0]["methods"]:
        for zoom in ("1", "2"):
            assert method["zoom"][zoom]["psnr"] == pytest.approx(expected[zoom]["psnr"], abs=1e-9)
            assert method["zoom"][zoom]["ssim"] == pytest.approx(expected[zoom]["ssim"], abs=1e-6)
        assert method["zoom"]["2"]["detail"]["render"] == pytest.approx(expected["2"]["detail"]["render"], abs=1e-6)
        assert method["zoom"]["2"]["enlarged_psnr"] == pytest.approx(expected["2"]["enlarged_psnr"], abs=1e-9)
        assert "consistency" in method["zoom"]["2"]


def test_pictures_get_consistency_by_the_depth_of_a_model(tmp_path: Path) -> None:
    subject = made_subject(tmp_path / "near", "every:2")
    pictures = write_method(subject, tmp_path / "pictures")
    write_gaussians(tmp_path / "model.ply", splats(subject))
    words = [f"noisy={pictures}", *subject.words, "--depth", str(tmp_path / "model.ply")]
    (method,) = judged(tmp_path / "out", *words)["results"][0]["methods"]
    levels = method["zoom"]["2"]["consistency"]
    assert levels["render"] != levels["truth"]


def test_repetitions_and_differences(subject: Subject, pictures: Path, tmp_path: Path) -> None:
    better = [write_method(subject, tmp_path / f"better{seed}", strength=5 + seed) for seed in (0, 1)]
    words = [f"better={better[0]}", f"better={better[1]}", f"noisy={pictures}", *subject.words]
    content = judged(tmp_path / "out", *words, "--against", "noisy")
    rows = {(row["zoom"], row["method"]): row for row in content["rows"]}
    gap = rows["1", "better"]["psnr"] - rows["1", "noisy"]["psnr"]
    assert rows["1", "better"]["difference_mean"] == pytest.approx(gap, abs=1e-9)
    assert rows["1", "better"]["difference_over_views"] > 0
    assert rows["1", "better"]["difference_over_repetitions"] > 0
    assert "difference_mean" not in rows["1", "noisy"]
    assert "better" in (tmp_path / "out" / "comparison.html").read_text()


def test_several_prepared_scenes_and_protocols(subject: Subject, tmp_path: Path, capsys) -> None:
    other = made_subject(tmp_path / "other")
    for one in (subject, other):
        write_method(one, tmp_path / "pictures" / one.folder.name)
        words = ["prepare", *one.words, "--to", str(tmp_path / "prepared" / one.folder.name), "eval.zoom=[1,2]"]
        assert main([word for word in words if not word.startswith("eval.competitor")]) == 0
    folders = [str(tmp_path / "prepared" / one.folder.name) for one in (subject, other)]
    method = f"noisy={tmp_path}/pictures/{{scene}}"
    content = judged(tmp_path / "out", method, *folders, *QUICK)
    assert [result["named"] for result in content["results"]] == ["scene", "other"]
    assert {row["scene"] for row in content["means"]} == {"mean of 2"}
    assert "mean of 2" in capsys.readouterr().out


def test_another_competitor_is_a_setting(subject: Subject, pictures: Path, tmp_path: Path) -> None:
    words = [word for word in subject.words if not word.startswith("eval.competitor")]
    words = [f"noisy={pictures}", *words, "regenerator/upscale@eval.competitor=lanczos"]
    (result,) = judged(tmp_path / "out", *words)["results"]
    assert result["competitor"]["name"] == "lanczos"
    assert "upscaled_psnr" in result["methods"][0]["zoom"]["2"]


# -- matching ----------------------------------------------------------------------------------------------------------


def test_numbered_pictures_of_3dgs_are_taken_in_order(subject: Subject, tmp_path: Path) -> None:
    place = tmp_path / "model" / "test" / "ours_30000"
    for name in ("renders", "gt"):
        (place / name).mkdir(parents=True)
    for number, (_, truth) in enumerate(subject.truths(1)):
        write_image(place / "renders" / f"{number:05d}.png", noisy(truth, 10, number))
        write_image(place / "gt" / f"{number:05d}.png", noisy(truth, 1, number))
    (method,) = judged(tmp_path / "out", f"gs={tmp_path / 'model'}", *subject.words)["results"][0]["methods"]
    assert method["layout"] == "3D-GS"
    assert any("in the order of the test views" in note for note in method["notes"])
    assert any("photos that it compared with" in note for note in method["notes"])
    assert method["zoom"]["1"]["psnr"] > 25


def test_numbers_in_another_order_are_refused(subject: Subject, tmp_path: Path, capsys) -> None:
    (tmp_path / "renders").mkdir()
    truths = [truth for _, truth in subject.truths(1)]
    for number, truth in enumerate([truths[1], truths[2], truths[0]]):
        write_image(tmp_path / "renders" / f"{number:05d}.png", noisy(truth, 5))
    assert main(["judge", f"a={tmp_path / 'renders'}", *subject.words, "--to", str(tmp_path / "out")]) == 2
    assert "resemble another view" in capsys.readouterr().err
    views = [view.name for view in subject.scene.test]
    order = tmp_path / "order.txt"
    order.write_text("\n".join([views[1], views[2], views[0]]))
    words = [f"a={tmp_path / 'renders'}", *subject.words, "--order", str(order)]
    (method,) = judged(tmp_path / "out", *words)["results"][0]["methods"]
    assert method["zoom"]["1"]["psnr"] > 30


def test_cameras_json_of_3dgs_names_the_views(subject: Subject, tmp_path: Path) -> None:
    place = tmp_path / "model" / "test" / "ours_7" / "renders"
    place.mkdir(parents=True)
    views = [view.name for view in subject.scene.test]
    truths = {view.name: truth for view, truth in subject.truths(1)}
    order = [views[2], views[0], views[1]]
    for number, name in enumerate(order):
        write_image(place / f"{number:05d}.png", noisy(truths[name], 5))
    entries = [{"id": number, "img_name": name} for number, name in enumerate([*order, "trained.jpg"])]
    (tmp_path / "model" / "cameras.json").write_text(json.dumps(entries))
    (method,) = judged(tmp_path / "out", f"gs={tmp_path / 'model'}", *subject.words)["results"][0]["methods"]
    assert method["zoom"]["1"]["psnr"] > 30


def test_pairs_of_nerfstudio_are_cut(subject: Subject, tmp_path: Path) -> None:
    (tmp_path / "pairs").mkdir()
    for number, (_, truth) in enumerate(subject.truths(1)):
        pair = torch.cat([truth, noisy(truth, 10, number)], 2)
        write_image(tmp_path / "pairs" / f"eval_img_{number:04d}.png", pair)
    (method,) = judged(tmp_path / "out", f"ns={tmp_path / 'pairs'}", *subject.words)["results"][0]["methods"]
    assert 25 < method["zoom"]["1"]["psnr"] < 35
    assert method["layout"] == "nerfstudio"


def test_rounded_sizes_are_stated_and_the_photo_is_reduced_to_them(subject: Subject, tmp_path: Path) -> None:
    (tmp_path / "rounded").mkdir()
    for view, _ in subject.truths(1):
        camera = view.camera.resize(view.camera.width - 1, view.camera.height)
        write_image(tmp_path / "rounded" / f"{Path(view.name).stem}.png", view.source.image(camera))
    words = [f"a={tmp_path / 'rounded'}", *subject.words]
    (method,) = judged(tmp_path / "out", *words)["results"][0]["methods"]
    assert any("31 x 24 px instead of 32 x 24" in note for note in method["notes"])
    assert method["zoom"]["1"]["ssim"] == pytest.approx(1)  # equal pictures; JSON has no infinite PSNR


def test_peculiar_files_are_read_and_stated(subject: Subject, tmp_path: Path) -> None:
    (tmp_path / "odd").mkdir()
    writers = [sixteen_bits, transparent, array]
    for writer, (view, truth) in zip(writers, subject.truths(1), strict=True):
        writer(tmp_path / "odd" / Path(view.name).stem, noisy(truth, 10))
    (method,) = judged(tmp_path / "out", f"a={tmp_path / 'odd'}", *subject.words)["results"][0]["methods"]
    text = "; ".join(method["notes"])
    assert "1 picture: 16 bits, rounded to 8" in text
    assert "transparent" in text
    assert "float32 display values" in text
    assert method["zoom"]["1"]["psnr"] > 25


def sixteen_bits(path: Path, picture: torch.Tensor) -> None:
    buffer = oiio.ImageBuf((picture.permute(1, 2, 0).numpy().astype(np.uint16) * 257).copy())
    assert buffer.write(f"{path}.png")


def transparent(path: Path, picture: torch.Tensor) -> None:
    write_image(path.with_suffix(".png"), torch.cat([picture, torch.full_like(picture[:1], 255)]))


def array(path: Path, picture: torch.Tensor) -> None:
    np.save(path.with_suffix(".npy"), picture.permute(1, 2, 0).numpy().astype(np.float32) / 255)


# -- refusals ----------------------------------------------------------------------------------------------------------


def broken(kind: str, folder: Path) -> Path:
    """Breaks the pictures of a folder x1/."""
    first, *_ = sorted((folder / "x1").iterdir())
    if kind == "missing":
        first.unlink()
    elif kind == "misnamed":
        first.rename(first.with_name(f"{first.stem}_pred.png"))
    elif kind == "corrupt":
        first.write_bytes(first.read_bytes()[:200])
    elif kind == "no picture":
        first.write_text("nothing")
    elif kind == "other size":
        write_image(first, torch.zeros(3, 24, 27))
    elif kind == "two zooms":
        shutil.copy(folder / "x2" / first.name, first)
    elif kind == "twice":
        shutil.copy(first, first.with_suffix(".jpg"))
    elif kind == "values":
        np.save(first.with_suffix(".npy"), np.full((24, 32, 3), 200.0))
        first.unlink()
    elif kind == "beyond":
        write_image(first, torch.zeros(3, 96, 128))
    return folder


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("missing", "has no picture of test view"),
        ("misnamed", "_pred)"),
        ("corrupt", "is damaged"),
        ("no picture", "cannot be read"),
        ("other size", "32 x 24 at x1"),
        ("two zooms", "of several zooms"),
        ("twice", "has two pictures of view"),
        ("values", "values from 200 to 200"),
        ("beyond", "has no pixels"),
    ],
)
def test_unusable_pictures_are_refused_in_a_sentence(
    kind: str, sentence: str, subject: Subject, pictures: Path, tmp_path: Path, capsys
) -> None:
    folder = broken(kind, Path(shutil.copytree(pictures, tmp_path / "pictures")))
    assert main(["judge", f"a={folder}", *subject.words, "--to", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert "Traceback" not in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pictures"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["{subject}"], "needs at least one method"),
        (["a={pictures}"], "needs the scene"),
        (["a={pictures}", "{subject}", "{pictures}"], "second scene"),
        (["a={pictures}", "b=nowhere", "{subject}"], "no such file or folder"),
        (["a={subject}", "{subject}", "scene.split=none"], "test views"),
        (["a={pictures}", "{subject}", "eval.colours=fitted"], "leave out eval.colours=fitted"),
        (["a={pictures}", "{subject}", "--against", "c"], "--against c"),
        (["a={pictures}", "{subject}", "--order", "nowhere.txt"], "does not exist"),
        (["a={pictures}", "nowhere"], "neither NAME=PATH"),
        (["a={empty}", "{subject}"], "holds no pictures"),
        (["a={file}", "{subject}"], "is no splat file"),
    ],
)
def test_unusable_words_are_refused_in_a_sentence(
    words: list[str], sentence: str, subject: Subject, pictures: Path, tmp_path: Path, capsys
) -> None:
    (tmp_path / "empty").mkdir()
    places = {"subject": subject.folder, "pictures": pictures, "empty": tmp_path / "empty", "file": __file__}
    filled = [word.format(**places) for word in words]
    settings = [word for word in subject.words[1:] if word.partition("=")[0] not in " ".join(words)]
    assert main(["judge", *filled, *settings, "--to", str(tmp_path / "out")]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_partial_judges_the_views_that_all_methods_have(subject: Subject, pictures: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(pictures, tmp_path / "pictures"))
    sorted((folder / "x1").iterdir())[0].unlink()
    words = [f"a={folder}", f"b={pictures}", *subject.words, "--partial"]
    first, second = judged(tmp_path / "out", *words)["results"][0]["methods"]
    assert len(first["views"]) == len(second["views"]) == 2
    assert any("has no pictures of 1 test view," in note for note in first["notes"])
    assert not any("has no pictures" in note for note in second["notes"])


def test_a_file_in_other_coordinates_is_doubted(subject: Subject, tmp_path: Path) -> None:
    gaussians = splats(subject)
    write_gaussians(tmp_path / "far.ply", replace(gaussians, means=gaussians.means + 1000))
    words = [f"a={tmp_path / 'far.ply'}", *subject.words]
    (method,) = judged(tmp_path / "out", *words)["results"][0]["methods"]
    assert "is in other coordinates" in "; ".join(method["notes"])
