"""Pages over runs with hostile names, in headless Chromium: nothing of a name is carried out, nothing is asked for."""

import json
import os
import random
import shutil
import subprocess
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from tiny import tiny_run

from faults.record import record, some
from gsx.experiments.reports.report import report_on, write_report

pytestmark = pytest.mark.faults

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PAGES, RUNS = 10, 50
"""Pages over runs, and runs of each; two names a run, and more in what they tell."""
HIT = "document.documentElement.dataset.hit=1"
FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
         "--disable-component-update", "--disable-sync", "--disable-quic", "--virtual-time-budget=3000"]  # fmt: skip


@pytest.fixture(scope="module")
def server() -> Iterator[tuple[str, list[str]]]:
    """Address of a server, and what it was asked for."""
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(404)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    made = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=made.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{made.server_address[1]}", asked
    made.shutdown()
    made.server_close()


def payloads(address: str) -> list[str]:
    """Texts that do something where they are taken for markup, script or style."""
    return [
        f"<script>{HIT}</script>",
        f'"><img src=x onerror="{HIT}">',
        f"'><svg onload={HIT}>",
        f"</title></style></script><script>{HIT}</script>",
        f"<iframe srcdoc='<script>parent.{HIT}</script>'>",
        f"<img src={address}/image>",
        f"<link rel=stylesheet href={address}/style>",
        f"<meta http-equiv=refresh content='0;url={address}/meta'>",
        f"</svg><image href={address}/svg>",
        f"red;background:url({address}/css)",
        f"javascript:{HIT}",
        f"{{{{ 7*7 }}}}{{% raw %}}<base href={address}/base>",
        f"<body onload={HIT}>&lt;script&gt;{HIT}&lt;/script&gt;",
        f"\u202e<details open ontoggle={HIT}>\ud83d\ude00".encode("utf-16", "surrogatepass").decode("utf-16"),
        f"`${{{HIT}}}`]]><!--<script>{HIT}//-->",
    ]


def seen(page: Path, profile: Path) -> str:
    """The document as the browser has it in the end."""
    assert BROWSER is not None
    command = [BROWSER, *FLAGS, f"--user-data-dir={profile}", "--dump-dom", page.resolve().as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout


def refuse_hit(document: str, asked: list[str], place: str) -> None:
    """Nothing may have happened."""
    assert document.count("<") > 20, place
    assert "data-hit" not in document.split(">", 2)[1] + document[:300], place
    assert asked == [], place


def hostile_run(example: Path, folder: Path, texts: list[str]) -> None:
    """A copy of a run that tells hostile texts wherever a run tells a text."""
    shutil.copytree(example, folder)
    first, second, third = texts
    config = (folder / "config.yaml").read_text().replace("variant: ''", f"variant: {json.dumps(first)}")
    (folder / "config.yaml").write_text(config)
    evaluation = json.loads((folder / "evaluation.json").read_text())
    evaluation["notes"], evaluation["protocol"]["hash"] = [first, second], third
    evaluation["views"] = [view | {"name": second} for view in evaluation["views"]]
    (folder / "evaluation.json").write_text(json.dumps(evaluation))
    index = json.loads((folder / "renders" / "index.json").read_text())
    index["views"] = [view | {"name": third} for view in index["views"]]
    (folder / "renders" / "index.json").write_text(json.dumps(index))
    environment = json.loads((folder / "environment.json").read_text())
    environment |= {"python": first, "device": second, "scene": environment["scene"] | {"notes": [third]}}
    environment["history"] = [{"at": first, "step": 1, "changed": {second: [third, first]}}]
    (folder / "environment.json").write_text(json.dumps(environment))
    (folder / "status.json").write_text(json.dumps({"state": "failed", "reason": first, "step": 2}))


@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium on this machine")
def test_names_are_texts_and_nothing_else(tmp_path: Path, server: tuple[str, list[str]]) -> None:
    address, asked = server
    choice, texts = random.Random(0), payloads(address)
    bare = tmp_path / "bare.html"  # the test must see what it looks for
    bare.write_text(f"<html><body>{texts[0]}{texts[5]}</body></html>")
    assert "data-hit" in seen(bare, tmp_path / "profile")[:300]
    assert asked == ["/image"]
    asked.clear()
    tiny_run(tmp_path / "run", ["iterations=2", "training.log_every=1", "rasterizer=eager"])
    with record("names that are markup, script or style, on pages in Chromium", seed=0) as counts:
        for number in some(range(PAGES)):
            below = tmp_path / f"page_{number}"
            for index in range(RUNS):
                chosen = [f"{choice.choice(texts)}{index}" for _ in range(3)]
                name = os.path.basename(chosen[0].replace("/", "\u2215"))[:80]
                hostile_run(tmp_path / "run", below / f"{index} {name}", chosen)
                counts.cases += 4
            page = report_on([below])
            refuse_hit(seen(page, tmp_path / "profile"), asked, str(page))
            single = write_report(next(path for path in below.iterdir() if path.is_dir()))
            refuse_hit(seen(single, tmp_path / "profile"), asked, str(single))
            shutil.rmtree(below)
