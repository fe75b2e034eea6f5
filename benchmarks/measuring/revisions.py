"""Another revision of the source, to be measured beside this one."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from measuring.machine import ROOT


@contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """The source of a revision, for a while."""
    with TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        subprocess.run(["git", "-C", str(ROOT), "worktree", "add", "--detach", str(tree), revision], check=True)
        try:
            link = tree / "src" / "gsx" / "conf"
            if not link.exists():
                link.symlink_to(tree / "conf")
            yield tree / "src"
        finally:
            subprocess.run(["git", "-C", str(ROOT), "worktree", "remove", "--force", str(tree)], check=True)
