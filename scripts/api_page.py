"""Write the page reference/api.md of the site from the docstrings of modules that scripts and plugins import.

The sources are parsed, not imported, so that signatures read as they are written.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "src"
MODULES = {
    "For scripts": ("gsx.api",),
    "For every plugin": (
        "gsx.core.plugins",
        "gsx.core.errors",
        "gsx.core.options",
        "gsx.core.ranges",
        "gsx.core.seeds",
    ),
    "Scenes and photos": (
        "gsx.core.data.scene",
        "gsx.core.data.scene_format",
        "gsx.core.data.camera",
        "gsx.core.data.window",
        "gsx.core.data.images",
        "gsx.core.data.masks",
        "gsx.core.data.resize",
        "gsx.core.data.reduction",
    ),
    "Gaussians and rasterizer": (
        "gsx.core.gaussians.splats",
        "gsx.core.gaussians.sh",
        "gsx.core.gaussians.quaternions",
        "gsx.core.rasterizer.settings",
        "gsx.core.rasterizer.render",
        "gsx.core.rasterizer.compositor",
        "gsx.core.backend",
    ),
    "Training": (
        "gsx.core.training.run",
        "gsx.core.training.backbone",
        "gsx.core.training.parameter_table",
        "gsx.core.training.schedule",
        "gsx.core.training.render",
        "gsx.core.training.training_views",
        "gsx.core.training.module",
        "gsx.core.training.learned_module",
        "gsx.core.training.augmenter",
        "gsx.core.training.pseudo_views",
        "gsx.core.training.regenerator",
    ),
    "Quality": (
        "gsx.core.quality.metrics",
        "gsx.core.quality.losses",
        "gsx.core.quality.colour_matrix",
        "gsx.core.quality.sharpness",
    ),
}
"""Headings of the page and the modules below each."""
BEGINNING = """# Python API

Look up what a script or a plugin can import. A page of the site, made from docstrings by `scripts/api_page.py`.

    import gsx
    help(gsx.train)

[Use gsx from Python](python.md) has worked examples for scripts. [Write a plugin](../how-to/write-a-plugin.md) says
which of these names a plugin needs. Shapes of tensors are in the annotations: `Float[Tensor, "3 H W"]` has three
channels, then rows, then columns.
"""
SECTION = re.compile(r"(Args|Returns|Yields|Raises|Source):$")
Definition = ast.ClassDef | ast.FunctionDef


def api_page() -> str:
    """Return the page in Markdown."""
    parts = [BEGINNING]
    for heading, modules in MODULES.items():
        parts += [f"\n## {heading}\n", *map(module_text, modules)]
    return "\n".join(parts)


def module_text(name: str) -> str:
    """Return the part of one module: its docstring, then each public name."""
    tree = parsed(name)
    described = map(definition_text, offered(tree))
    return "\n".join([f"\n### {name}\n", prose(ast.get_docstring(tree)), *described])


def parsed(module: str) -> ast.Module:
    """Return the syntax tree of a module of gsx."""
    file = SOURCE / f"{module.replace('.', '/')}.py"
    return ast.parse(file.read_text(encoding="utf-8"))


def offered(tree: ast.Module) -> list[Definition]:
    """Return the public definitions of a module: those in its `__all__`, also imported ones; without it its own."""
    known = {node.name: node for node in public(tree.body)}
    names = [
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    ]
    if not names:
        return list(known.values())
    return [known.get(name) or imported(tree, name) for name in ast.literal_eval(names[0])]


def imported(tree: ast.Module, name: str) -> Definition:
    """Return a definition that a module imports, under the name that it has there.

    Raises:
        LookupError: the module does not import it.
    """
    for node in tree.body:
        for alias in node.names if isinstance(node, ast.ImportFrom) and node.module else []:
            if name == (alias.asname or alias.name):
                [found] = [one for one in public(parsed(node.module).body) if one.name == alias.name]
                found.name = name
                return found
    raise LookupError(f"{name} is neither defined nor imported")


def public(body: list[ast.stmt]) -> Iterator[Definition]:
    """Yield classes and functions whose names are public and that have a docstring."""
    for node in body:
        if isinstance(node, Definition) and not node.name.startswith("_") and ast.get_docstring(node):
            yield node


def definition_text(node: Definition) -> str:
    """Return heading, signature and docstring of a class or function; of a class its attributes and methods as well."""
    lines = [f"\n#### {node.name}\n", f"```python\n{signature(node)}\n```\n", prose(ast.get_docstring(node))]
    if isinstance(node, ast.ClassDef):
        lines += [f"* `{name}`{': ' if text else ''}{escaped(text)}" for name, text in attributes(node)]
        lines += [method_text(method) for method in public(node.body) if isinstance(method, ast.FunctionDef)]
    return "\n".join(lines)


def method_text(node: ast.FunctionDef) -> str:
    """Return signature and docstring of a method."""
    return f"\n```python\n{signature(node)}\n```\n\n{prose(ast.get_docstring(node))}"


def signature(node: Definition) -> str:
    """Return the definition's first line without its colon; `@property` where it is one."""
    if isinstance(node, ast.ClassDef):
        bases = ", ".join(map(ast.unparse, node.bases))
        return f"class {node.name}({bases})" if bases else f"class {node.name}"
    marks = [f"@{text}\n" for text in map(ast.unparse, node.decorator_list) if text in ("property", "staticmethod")]
    returned = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return f"{''.join(marks)}def {node.name}({wrapped(ast.unparse(node.args))}){returned}"


def wrapped(arguments: str) -> str:
    """Return long arguments with one line for each."""
    if len(arguments) < 80:
        return arguments
    parts = re.split(r", (?=\*{0,2}[a-z_]+(?::|=|$|, ))(?![^\[]*\])", arguments)
    return "".join(f"\n    {part}," for part in parts) + "\n"


def attributes(node: ast.ClassDef) -> Iterator[tuple[str, str]]:
    """Yield the public annotated attributes as `name: type`, with the docstring below them or an empty text."""
    for first, second in zip(node.body, [*node.body[1:], ast.Pass()], strict=True):
        if isinstance(first, ast.AnnAssign) and not ast.unparse(first.target).startswith("_"):
            value = second.value if isinstance(second, ast.Expr) else None
            text = value.value if isinstance(value, ast.Constant) and isinstance(value.value, str) else ""
            yield f"{ast.unparse(first.target)}: {ast.unparse(first.annotation)}", " ".join(text.split())


def prose(docstring: str | None) -> str:
    """Return a docstring as Markdown: sections such as Raises become lists, other indented lines stay code."""
    lines, section = [], False
    for line in (docstring or "").splitlines():
        if SECTION.match(line):
            section = True
            lines += ["", f"**{line}**", ""]
        elif section and line.startswith("    "):
            item = line.strip()
            lines.append(f"* {escaped(item)}" if line[4] != " " else f"  {escaped(item)}")
        else:
            section = False
            lines.append(line if line.startswith("    ") else escaped(line))
    return "\n".join([*lines, ""])


def escaped(text: str) -> str:
    """Return text whose marks outside of backticks are literal."""
    pieces = re.split(r"(`[^`]*`)", text)
    return "".join(p if p.startswith("`") else re.sub(r"([*_<\[\]])", r"\\\1", p) for p in pieces)
