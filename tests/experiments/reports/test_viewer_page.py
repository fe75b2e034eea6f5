"""The page that opens from disk: in a browser without network, beside our own render."""

import json
import re
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from browser import CHROMIUM, browser
from tiny import tiny_run

from gsx.builtin import plugins
from gsx.core.data.images import read_image
from gsx.core.gaussians.splats import Gaussians
from gsx.core.quality.metrics import psnr
from gsx.core.training.render import render
from gsx.experiments.runs.export import export
from gsx.experiments.runs.open import open_run
from gsx.formats.splat_files import write_gaussians

ZOOM = 10
"""Times the tiny pictures, of 48 x 36 px."""


def splats() -> Gaussians:
    g = torch.Generator().manual_seed(0)
    count = 400
    return Gaussians(
        means=torch.rand(count, 3, generator=g) * torch.tensor([1.6, 1.6, 1.2]) - torch.tensor([0.8, 0.8, 0.0]),
        log_scales=torch.randn(count, 3, generator=g) * 0.5 - 3.0,
        quats=torch.randn(count, 4, generator=g),
        opacity_logits=torch.full((count,), 3.0),
        sh_dc=torch.randn(count, 3, generator=g),
        sh_rest=0.2 * torch.randn(count, 15, 3, generator=g),
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of a run of four hundred splats, in a folder whose name is no address.

    Small and opaque ones: the viewer lets Gaussians end earlier than 3D-GS does, which soft ones show.
    """
    folder = tmp_path_factory.mktemp("page")
    write_gaussians(folder / "splats.ply", splats())
    tiny_run(folder / "run", [f"init={folder / 'splats.ply'}", "iterations=0", "rasterizer=eager"])
    run, _ = open_run(folder / "run", plugins())
    path = folder / "it's 100% <a> page.html"
    assert export(run, path)
    return path


def test_it_holds_settings_of_the_viewers_second_version(page: Path) -> None:
    text = page.read_text()
    (content,) = re.findall(r'id="sse-bootstrap">\s*(.*?)\s*</script>', text, re.DOTALL)
    settings = json.loads(content)["settings"]
    assert settings["version"] == 2
    assert len(settings["cameras"]) == 1
    assert [one["title"] for one in settings["annotations"]] == ["test_001"]
    assert "MIT License" in text
    assert "GSX_" not in text


@pytest.mark.skipif(CHROMIUM is None or find_spec("websockets") is None, reason="no Chromium, or no websockets")
def test_a_browser_shows_it_from_disk_as_we_draw_it(page: Path, tmp_path: Path) -> None:
    run, _ = open_run(page.parent / "run", plugins())
    camera = run.scene.test[0].camera
    width, height = ZOOM * camera.width, ZOOM * camera.height
    with browser(width, height) as shown:
        shown.take_network_away()
        shown.open(page.as_uri() + "?noui&noanim&webgl")
        shown.wait_for("typeof window.captureFrame === 'function'")
        shown.value("new Promise(done => setTimeout(done, 3000))")  # sorted once more, and drawn
        picture = read_image(shown.picture(tmp_path / "shown.png"))[:3] / 255
        assert shown.said == []
        assert all(address.startswith(("file:", "data:", "blob:")) for address in shown.asked)
    assert psnr(picture, render(run, camera.zoom(ZOOM)).image) >= 30
