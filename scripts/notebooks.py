"""Notebooks with their outputs, from examples/notebooks/*.py: python scripts/notebooks.py (extra `notebooks`)

A cell begins with `# %%`, text with `# %% [markdown]`. Each is run in a folder of its own by Jupyter's kernel.
"""

import tempfile
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[1] / "examples" / "notebooks"
SECONDS = 600
"""That a cell may take."""


def cells_of(source: str) -> list[tuple[str, str]]:
    """(code or markdown, text) of each cell."""
    cells = []
    for part in source.split("# %%")[1:]:
        head, _, body = part.partition("\n")
        kind = "markdown" if "[markdown]" in head else "code"
        lines = body.strip("\n").splitlines()
        text = "\n".join(line.removeprefix("#").removeprefix(" ") for line in lines) if kind == "markdown" else body
        cells.append((kind, text.strip("\n")))
    return cells


def executed(source: str) -> Any:
    """The notebook with what its cells gave; it must not fail."""
    import nbformat
    from nbclient import NotebookClient

    make = {"code": nbformat.v4.new_code_cell, "markdown": nbformat.v4.new_markdown_cell}
    notebook = nbformat.v4.new_notebook(cells=[make[kind](text) for kind, text in cells_of(source)])
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"  # else random
    with tempfile.TemporaryDirectory() as place:
        NotebookClient(notebook, timeout=SECONDS, resources={"metadata": {"path": place}}).execute()
    for cell in notebook.cells:
        cell.get("metadata", {}).pop("execution", None)  # times
        outputs = cell.get("outputs", [])
        cell["outputs"] = [one for one in outputs if one.output_type != "stream"] if outputs else outputs
        if cell.cell_type == "markdown":
            cell.pop("outputs")
    notebook.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    return notebook


def main() -> None:
    """Execute all of them."""
    import nbformat

    for path in sorted(FOLDER.glob("*.py")):
        notebook = executed(path.read_text(encoding="utf-8"))
        path.with_suffix(".ipynb").write_text(nbformat.writes(notebook) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
