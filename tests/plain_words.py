"""Counts of words and fragments that a newcomer has to translate, by where they stand.

`python tests/plain_words.py` prints the lines, `--write` lowers the committed counts in plain_words.json.
"""

import ast
import io
import json
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

from pages import PAGES, ROOT

SOURCE, SETTINGS = ROOT / "src" / "gsx", ROOT / "conf"
COUNTS = Path(__file__).with_suffix(".json")
DIALECT = re.compile(
    r"(?<!=)(?<!gsx )\b(told|tells?|seen|shown|given|asked|judg(?:e|es|ed|ing)|begun|wanted|doomed|heal(?:s|ed)?"
    r"|earn(?:s|ed)?|heeded|withheld|undone|beside|whoever|looked at|died without a word|taken for (?:right|wrong))\b",
    re.I,
)
"""Participles and metaphors in place of the field's nouns and verbs: report, evaluate, compare with, held-out.

`gsx judge` is the name of a command."""
FRAGMENT = re.compile(r"(What|Whether|Of|Those|Where|Which|Whose|How|That|Whatever|Whoever)\b")
"""First words of a docstring that is no sentence."""


def prose(page: str) -> str:
    """Return a page's text without code, comments and targets of links; lines stay."""
    page = re.sub(r"^```.*?^```$|<!--.*?-->", lambda found: "\n" * found[0].count("\n"), page, flags=re.M | re.S)
    return re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`\n]*`", "``", page))


def docstrings(tree: ast.AST) -> Iterator[ast.Constant]:
    """Yield the docstrings of modules, classes and functions, and the strings below attributes."""
    for node in ast.walk(tree):
        for statement in getattr(node, "body", []) if not isinstance(node, ast.Lambda | ast.IfExp) else []:
            value = statement.value if isinstance(statement, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield value


def messages(tree: ast.AST) -> Iterator[ast.Constant]:
    """Yield the other strings that have several words: help, errors, log lines, labels."""
    known = {id(text) for text in docstrings(tree)}
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and " " in node.value
            and id(node) not in known
        ):
            yield node


def names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield the names that a module defines: functions, classes, arguments, variables."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id if isinstance(node, ast.Name) else node.attr


def comments(source: str) -> Iterator[tuple[int, str]]:
    """Yield the comments of a module."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def visible(page: str) -> str:
    """Return the text of a template without scripts, styles, tags and expressions; lines stay."""
    for hidden in (r"<(script|style)\b.*?</\1>", r"<!--.*?-->|{%.*?%}|{{.*?}}|{#.*?#}", r"<[^>]*>"):
        page = re.sub(hidden, lambda found: "\n" * found[0].count("\n"), page, flags=re.S)
    return page


def found_in_source(file: Path) -> Iterator[tuple[str, int, str]]:
    """Yield kind, line and text of each find in a module of `src`."""
    source = file.read_text()
    tree = ast.parse(source)
    texts = [("docstrings", node.lineno, node.value) for node in docstrings(tree)]
    texts += [("messages", node.lineno, node.value) for node in messages(tree)]
    texts += [("docstrings", line, text) for line, text in comments(source)]
    for kind, line, text in texts:
        finds = len(DIALECT.findall(text)) + (kind == "docstrings" and bool(FRAGMENT.match(text)))
        yield from [(kind, line, text)] * finds
    for line, name in names(tree):
        if DIALECT.search(name.replace("_", " ")):
            yield "names", line, name


def finds() -> Iterator[tuple[str, str, int, str]]:
    """Yield kind, file, line and text of all finds."""
    for page in PAGES:
        kind = "README" if page.name == "README.md" else "docs"
        for number, line in enumerate(prose(page.read_text()).splitlines(), 1):
            yield from ((kind, str(page.relative_to(ROOT)), number, line) for _ in DIALECT.findall(line))
    for file in sorted(SETTINGS.rglob("*.yaml")):
        for number, line in enumerate(file.read_text().splitlines(), 1):
            text = line.partition("#")[2]
            yield from (("settings", str(file.relative_to(ROOT)), number, text) for _ in DIALECT.findall(text))
    for file in sorted(SOURCE.rglob("*.html")):
        for number, line in enumerate(visible(file.read_text()).splitlines(), 1):
            yield from (("messages", str(file.relative_to(ROOT)), number, line) for _ in DIALECT.findall(line))
    for file in sorted(SOURCE.rglob("*.py")):
        yield from ((kind, str(file.relative_to(ROOT)), line, text) for kind, line, text in found_in_source(file))


def counts() -> dict[str, int]:
    """Return the number of finds of each kind."""
    kinds = [kind for kind, *_ in finds()]
    return {kind: kinds.count(kind) for kind in ("README", "docs", "settings", "messages", "docstrings", "names")}


if __name__ == "__main__":
    if "--write" in sys.argv:
        lowest = json.loads(COUNTS.read_text()) if COUNTS.exists() else {}
        now = {kind: min(count, lowest.get(kind, count)) for kind, count in counts().items()}
        COUNTS.write_text(json.dumps(now, indent=2) + "\n")
    else:
        prefixes = [word for word in sys.argv[1:] if not word.startswith("-")]
        for kind, file, line, text in finds():
            if not prefixes or any(file.startswith(prefix) for prefix in prefixes):
                print(f"{kind:10} {file}:{line}: {' '.join(text.split())[:140]}")
    print(counts())
