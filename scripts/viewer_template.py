"""Make the page that `gsx export RUN model.html` fills, once for every version of the viewer: needs Node.js and npm.

    python scripts/viewer_template.py

The viewer is npm's @playcanvas/supersplat-viewer (MIT), of the version and digest named here; its own
`renderViewerHtml` writes the page with script and style inside. Who installs gsx needs neither Node nor network.
"""

import base64
import hashlib
import lzma
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

PACKAGE, VERSION = "@playcanvas/supersplat-viewer", "1.36.2"
SHA512 = "L7w0BlagAonRHQg5qhaDyBB8zrRtiU9QgglNU3kUgsqHpokCAtuf9j4P0kxsUaQn61FZ1qJGkRKsOCbrLCDR0w=="
TARGET = Path(__file__).parents[1] / "src" / "gsx" / "experiments" / "reports" / "viewer_page.html.xz"
PLACE = "GSX_BOOTSTRAP"
"""Stands where gsx puts settings and splats."""
RENDER = f"""
import {{ renderViewerHtml }} from './index.js';
process.stdout.write(renderViewerHtml({{
    bootstrap: '{PLACE}', inlineCss: true, inlineJs: true, headExtras: '<!-- GSX_NOTICE -->'
}}));
"""


def main() -> None:
    """Write TARGET."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        archive = folder / run(folder, "npm", "pack", "--silent", f"{PACKAGE}@{VERSION}").strip().splitlines()[-1]
        digest = base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
        if digest != SHA512:
            sys.exit(f"{PACKAGE} {VERSION} has sha512 {digest}, expected {SHA512}")
        with tarfile.open(archive) as content:
            content.extractall(folder, filter="data")
        dist = folder / "package" / "dist"
        (dist / "render.mjs").write_text(RENDER)
        page = run(dist, "node", "render.mjs")
        notice = f"{PACKAGE} {VERSION}\n\n{(folder / 'package' / 'LICENSE').read_text().strip()}\n"
    assert page.count(f'"{PLACE}"') == 1, "the page has no place for settings"
    page = page.replace("<!-- GSX_NOTICE -->", f"<!--\n{notice}-->", 1)
    TARGET.write_bytes(lzma.compress(page.encode(), preset=9 | lzma.PRESET_EXTREME))
    sys.stdout.write(f"{TARGET}: {TARGET.stat().st_size:,} bytes\n")


def run(folder: Path, *words: str) -> str:
    """What a program says."""
    return subprocess.run(words, cwd=folder, check=True, stdout=subprocess.PIPE, text=True, encoding="utf-8").stdout


if __name__ == "__main__":
    main()
