"""Explains a configuration key: its value, its type and range, the files that set it, and their comments."""

import re
from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from textwrap import shorten
from typing import Any

import yaml

from gsx.core.errors import ConfigError, command
from gsx.core.plugins import Plugins
from gsx.experiments.run_folder.general_options import GeneralOptions
from gsx.experiments.runs.compose import Compositions, Source, known_groups, listed
from gsx.experiments.runs.settings import COMPETITOR, Settings
from gsx.experiments.runs.typed import dotted, kind_in, unknown_key, value_at

WORDS = {"scene": "scene={}", "backbone": "backbone={}", "augmenter": "augmenter=[{}]", "experiment": "+experiment={}"}
"""Choices by groups whose options have keys of their own."""
WIDTH = 110
"""Characters of a comment that shares a line with a key or an option."""


@dataclass(frozen=True)
class Parsed:
    """A file of the configuration."""

    source: Source
    text: str
    node: yaml.Node | None
    """None: the file is empty."""


@dataclass(frozen=True)
class Entry:
    """A key in a file of the configuration."""

    place: str
    """File and line."""
    value: str
    """Text of its value; empty for a key with keys below it."""
    comment: str


def explain(key: str, overrides: Sequence[str], plugins: Plugins) -> list[str]:
    """Return lines on a key, a group or an option of one (`backbone=scaffold`), in a composition."""
    group, _, option = key.partition("=")
    with Compositions(plugins) as compositions:
        if option:
            overrides, key = [*overrides, key], group
        values, groups = compositions.values(overrides), known_groups()
        known = dict.fromkeys([*dotted(values), *groups])
        if key not in known:
            raise ConfigError(key_of_another_choice(key, overrides, compositions) or unknown_key(key, known))
        settings, files = compositions.settings(overrides), parsed(compositions.sources(overrides))
        dotted_key = key.replace("/", ".")  # the content of a nested group
        value = value_at(key, values)
        typed = [word.partition("=")[2] for word in overrides if word.startswith(f"{key}=")]
        details = [kind_of(key, settings), *(f"command line  {word}" for word in typed)]
        for entry in reversed(entries(files, dotted_key)):
            details += [f"set in {entry.place}  {entry.value}".rstrip(), entry.comment and f"    {entry.comment}"]
        lines = [key if value is MISSING or isinstance(value, dict) else f"{key} = {written(value)}"]
        lines += [f"  {detail}" for detail in details if detail]
        if key in groups:
            chosen = {file.source.file for file in files} - included(key, files)
            lines += ["", f"{key}=NAME, one of (* chosen)"]
            for name in listed(key):
                file = compositions.file(f"{key}/{name}")
                lines.append(f"{'*' if file in chosen else ' '} {name:24} {head_of(file)}".rstrip())
        return lines + below(dotted_key, values, files)


def key_of_another_choice(key: str, overrides: Sequence[str], compositions: Compositions) -> str:
    """Return an error that names a composition which has the key, such as scene=photos; empty: none has."""
    group = key.partition(".")[0]
    for name in listed(group) if group in WORDS else ():
        word = WORDS[group].format(name)
        try:
            found = key in dotted(compositions.values([*overrides, word]))
        except ConfigError:  # an option that needs others
            continue
        if found:
            return f"'{key}' is a setting of {word}: `{command('explain', key, word)}`"
    return ""


def included(group: str, files: Sequence[Parsed]) -> set[Path]:
    """Return the files of a group that others of the same group start from."""
    members = [file for file in files if file.source.file.parent.name == group.rpartition("/")[2]]
    bases = [
        (file.source.file, base) for file in members for base in (yaml.safe_load(file.text) or {}).get("defaults", [])
    ]
    plain = [(file, base.partition("@")[0].removeprefix(f"/{group}/")) for file, base in bases if isinstance(base, str)]
    return {file.with_name(f"{base}.yaml") for file, base in plain if "/" not in base}


def written(value: Any) -> str:
    """Return a value in the syntax of the command line."""
    text = yaml.safe_dump(value, default_flow_style=True, width=1 << 20, allow_unicode=True)
    return text.removesuffix("\n...\n").strip()


def below(key: str, node: dict[str, Any], files: Sequence[Parsed]) -> list[str]:
    """Return a line for each key below a key: value, and the comment of the file that sets it."""
    inner = value_at(key, node)
    lines = []
    for name in dotted(inner):
        value = value_at(name, inner)
        if not isinstance(value, dict):
            comment = shorten(comment_on(f"{key}.{name}", files), WIDTH, placeholder=" ...")
            lines.append(f"  {f'{name}: {written(value)}':34} {comment}".rstrip())
    return ["", f"below {key}:", *lines] if lines else []


def parsed(sources: Sequence[Source]) -> list[Parsed]:
    """Parse the files of a composition."""
    texts = [source.file.read_text(encoding="utf-8") for source in sources]
    nodes = [yaml.compose(text, Loader=yaml.SafeLoader) for text in texts]
    return [Parsed(source, text, node) for source, text, node in zip(sources, texts, nodes, strict=True)]


def comment_on(key: str, files: Sequence[Parsed]) -> str:
    """Return the comment on a key in the last file that has one, or an empty text."""
    return next((entry.comment for entry in reversed(entries(files, key)) if entry.comment), "")


def entries(files: Sequence[Parsed], key: str) -> list[Entry]:
    """Return the entries that set a key, in the order of merging."""
    found, parts = [], key.split(".")
    for file in files:
        package = file.source.package.split(".") if file.source.package else []
        if parts[: len(package)] == package and len(parts) > len(package):
            found.append(entry_in(file, parts[len(package) :]))
    return [entry for entry in found if entry]


def entry_in(file: Parsed, parts: Sequence[str]) -> Entry | None:
    """Return a key in one file; None: it is not set there."""
    name, node = None, file.node
    for part in parts:
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        name, node = next(((name, value) for name, value in pairs if name.value == part), (None, None))
    if name is None or node is None:
        return None
    lines, line, begin, end = file.text.splitlines(), name.start_mark.line, node.start_mark, node.end_mark
    inner = isinstance(node, yaml.MappingNode) and not node.flow_style
    rest = lines[line][name.end_mark.column if inner or end.line != line else end.column :]
    after = rest.partition(" #")[2].strip()
    comment = " ".join([*above(lines, line, name.start_mark.column), *([after] if after else [])])
    value = "" if inner else " ".join(file.text[begin.index : end.index].split())
    return Entry(place=f"{file.source.name}:{line + 1}", value=value, comment=comment)


def above(lines: Sequence[str], line: int, column: int) -> list[str]:
    """Return the comments above a key, but not the comment on a whole file at its head."""
    first = line
    while first > 0 and lines[first - 1].startswith(" " * column + "#"):
        first -= 1
    return [text.strip().lstrip("# ") for text in lines[first:line]] if first > 0 else []


def head_of(file: Path) -> str:
    """Return the first sentence of the comment at the head of a file."""
    words = []
    for line in file.read_text(encoding="utf-8").splitlines() if file.is_file() else []:
        if not line.startswith("#"):
            break
        words += [line.lstrip("# ")] if "@package" not in line else []
    return shorten(re.split(r"(?<!et al)\. ", " ".join(words))[0], WIDTH, placeholder=" ...")


def kind_of(key: str, settings: Settings) -> str:
    """Return type and range of a key in words; empty if no dataclass of options has it."""
    for prefix, schema in sorted(schemas(settings).items(), reverse=True):  # those below others first
        if key.startswith(prefix):
            return kind_in(schema, key.removeprefix(prefix).split("."))
    return ""


def schemas(settings: Settings) -> dict[str, type]:
    """Return dataclasses of options by the prefix of their keys; that of general options is empty."""
    single = {"training": settings.training, "eval": settings.evaluation, "rasterizer": settings.raster}
    several = {"training": settings.modules, "augmenter": settings.augmenters, "tracker": settings.trackers}
    several |= {"regenerator": settings.regenerators}
    chosen = {"scene": settings.scene, "backbone": settings.backbone}
    chosen |= {f"{group}.{name}": one for group, nodes in several.items() for name, one in nodes.items()}
    chosen |= {COMPETITOR: settings.competitor} if settings.competitor else {}
    found = {f"{key}.": type(options) for key, options in single.items()}
    found |= {f"{key}.": one.component.options for key, one in chosen.items()}
    return found | {"": GeneralOptions}
