"""What a key of the configuration is: its value, where that comes from, what is written beside it there, and what else
it may be."""

import re
import types
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, is_dataclass
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import yaml

from gsx.core.errors import ConfigError
from gsx.core.plugins import Plugins
from gsx.core.ranges import Range, parts_of
from gsx.experiments.run_folder.general_options import GeneralOptions
from gsx.experiments.runs.compose import Compositions, Source, known_groups, listed
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.typed import dotted, right_key

KINDS = {int: "whole number", float: "number", str: "text", bool: "true or false", Path: "path"}
WIDTH = 110
"""Characters of a comment where it shares a line with a key or an option."""


@dataclass(frozen=True)
class Parsed:
    """A file of the configuration."""

    source: Source
    text: str
    lines: list[str]
    node: yaml.Node | None
    """None: it holds nothing."""


@dataclass(frozen=True)
class Entry:
    """A key in a file of the configuration."""

    place: str
    """File and line."""
    value: str
    """As it is written there; empty where keys are below it."""
    comment: str


def explain(key: str, overrides: Sequence[str], plugins: Plugins) -> list[str]:
    """Lines on a key, a group or an option of one (`backbone=scaffold`), in a composition.

    Raises:
        ConfigError: there is no such key; the nearest is told.
    """
    group, _, option = key.partition("=")
    with Compositions(plugins) as compositions:
        if option:
            overrides, key = [*overrides, key], group
        values, groups = compositions.values(overrides), known_groups()
        known = dict.fromkeys([*dotted(values), *groups])
        if key not in known:
            raise ConfigError(f"'{key}' is no configuration key.{right_key(key, known)} `gsx --cfg job` lists all keys")
        settings, files = compositions.settings(overrides), parsed(compositions.sources(overrides))
        dotted_key = key.replace("/", ".")  # where what a nested group holds is
        lines = [headline(key, values), *indented(kind_of(key, settings))]
        lines += indented(
            *(f"command line  {word.partition('=')[2]}" for word in overrides if word.startswith(f"{key}="))
        )
        lines += indented(*(line for entry in reversed(entries(files, dotted_key)) for line in told(entry)))
        if key in groups:
            lines += ["", f"{key}=NAME, one of (* chosen)", *options_of(key, compositions, files)]
        return lines + below(dotted_key, values, files)


def indented(*texts: str) -> list[str]:
    """Those that are not empty, below a headline."""
    return [f"  {text}" for text in texts if text]


def options_of(group: str, compositions: Compositions, files: Sequence[Parsed]) -> list[str]:
    """Options of a group, a line each; those of the composition are marked."""
    chosen = {file.source.file for file in files}
    lines = []
    for name in listed(group):
        file = compositions.file(f"{group}/{name}")
        lines.append(f"{'*' if file in chosen else ' '} {name:24} {head_of(file)}".rstrip())
    return lines


def headline(key: str, node: dict[str, Any]) -> str:
    """The key and its value."""
    value = value_at(key, node)
    return key if value is MISSING or isinstance(value, dict) else f"{key} = {written(value)}"


def value_at(key: str, node: Any) -> Any:
    """What a dotted key stands for; MISSING: nothing."""
    for part in key.split("."):
        if not isinstance(node, dict) or part not in node:
            return MISSING
        node = node[part]
    return node


def written(value: Any) -> str:
    """A value as the command line has it."""
    text = yaml.safe_dump(value, default_flow_style=True, width=1 << 20, allow_unicode=True)
    return text.removesuffix("\n...\n").strip()


def told(entry: Entry) -> list[str]:
    """An entry in lines."""
    first = f"{entry.place}  {entry.value}".rstrip()
    return [first, *(f"    {line}" for line in [entry.comment] if line)]


def below(key: str, node: dict[str, Any], sources: Sequence[Parsed]) -> list[str]:
    """The keys below a key, a line each: value, and what the file says that sets it."""
    inner = value_at(key, node)
    if not isinstance(inner, dict) or not inner:
        return []
    lines = ["", f"below {key}:"]
    for name in dotted(inner):
        value = value_at(name, inner)
        if not isinstance(value, dict):
            found = entries(sources, f"{key}.{name}")
            comment = next((entry.comment for entry in reversed(found) if entry.comment), "")
            lines.append(f"  {f'{name}: {written(value)}':34} {comment[:WIDTH]}".rstrip())
    return lines


# -- files ---------------------------------------------------------------------------------------------------------


def parsed(sources: Sequence[Source]) -> list[Parsed]:
    """Files of a composition, read."""
    texts = [source.file.read_text(encoding="utf-8") for source in sources]
    return [
        Parsed(source, text, text.splitlines(), yaml.compose(text, Loader=yaml.SafeLoader))
        for source, text in zip(sources, texts, strict=True)
    ]


def entries(files: Sequence[Parsed], key: str) -> list[Entry]:
    """Where a key is set, in the order in which files take the place of one another."""
    found, parts = [], key.split(".")
    for file in files:
        package = file.source.package.split(".") if file.source.package else []
        if parts[: len(package)] == package and len(parts) > len(package):
            found.append(entry_in(file, parts[len(package) :]))
    return [entry for entry in found if entry]


def entry_in(file: Parsed, parts: Sequence[str]) -> Entry | None:
    """A key in one file; None: it is not set there."""
    name, node = None, file.node
    for part in parts:
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        name, node = next(((name, value) for name, value in pairs if name.value == part), (None, None))
        if name is None or node is None:
            return None
    assert name is not None
    assert node is not None
    line, begin, end = name.start_mark.line, node.start_mark, node.end_mark
    inner = isinstance(node, yaml.MappingNode) and not node.flow_style
    rest = file.lines[line][name.end_mark.column if inner or end.line != line else end.column :]
    comment = " ".join([*above(file.lines, line, name.start_mark.column), *after_hash(rest)])
    value = "" if inner else " ".join(file.text[begin.index : end.index].split())
    return Entry(place=f"{file.source.name}:{line + 1}", value=value, comment=comment)


def after_hash(text: str) -> list[str]:
    """The comment at the end of a line."""
    _, hash_, comment = text.partition(" #")
    return [comment.strip()] if hash_ else []


def above(lines: Sequence[str], line: int, column: int) -> list[str]:
    """Comments above a key, but for those at the head of a file, which are about all of it."""
    first = line
    while first > 0 and lines[first - 1].startswith(" " * column + "#"):
        first -= 1
    return [text.strip().lstrip("# ") for text in lines[first:line]] if first > 0 else []


def head_of(file: Path) -> str:
    """The first sentence of the comment that a file begins with."""
    words = []
    for line in file.read_text(encoding="utf-8").splitlines() if file.is_file() else []:
        if not line.startswith("#"):
            break
        words += [line.lstrip("# ")] if "@package" not in line else []
    return re.split(r"(?<!et al)\. ", " ".join(words))[0][:WIDTH]


# -- types ---------------------------------------------------------------------------------------------------------


def kind_of(key: str, settings: Settings) -> str:
    """What a value may be, in words; empty where the options of its component do not say."""
    for prefix, schema in sorted(schemas(settings).items(), reverse=True):  # those below others first
        if key.startswith(prefix):
            return kind_in(schema, key.removeprefix(prefix).split("."))
    return ""


def schemas(settings: Settings) -> dict[str, type]:
    """Dataclasses of options by the beginning of their keys; general options have none."""
    single = {"training": settings.training, "eval": settings.evaluation, "rasterizer": settings.raster}
    chosen = {"scene": settings.scene, "backbone": settings.backbone}
    chosen |= {f"training.{name}": one for name, one in settings.modules.items()}
    chosen |= {f"augmenter.{name}": one for name, one in settings.augmenters.items()}
    chosen |= {f"regenerator.{role}": one for role, one in settings.regenerators.items()}
    chosen |= {f"tracker.{name}": one for name, one in settings.trackers.items()}
    found = {f"{key}.": type(options) for key, options in single.items()}
    found |= {f"{key}.": one.component.options for key, one in chosen.items()}
    return found | {"": GeneralOptions}


def kind_in(schema: type, parts: Sequence[str]) -> str:
    """What a field of a dataclass may hold, in words."""
    hints = get_type_hints(schema, include_extras=True)
    if parts[0] not in hints:
        return ""
    hint = hints[parts[0]]
    if len(parts) > 1:
        inner = next((part for part in parts_of(hint) if isinstance(part, type) and is_dataclass(part)), None)
        return kind_in(inner, parts[1:]) if inner else ""
    bounds = next((part for part in parts_of(hint) if isinstance(part, Range)), None)
    return f"{in_words(hint)}{f' {bounds}' if bounds else ''}"


def in_words(hint: Any) -> str:
    """A type in words; empty: one that has none."""
    origin, inner = get_origin(hint), list(get_args(hint))
    if origin in (Union, types.UnionType):
        words = [in_words(part) for part in inner if part is not type(None)]
        return " or ".join([*filter(None, words), *(["null"] if type(None) in inner else [])])
    if origin in (list, tuple):
        return f"list of {in_words(inner[0])}s"
    if hasattr(hint, "__metadata__"):
        return in_words(inner[0])
    return KINDS.get(hint, "")


# -- all of it -----------------------------------------------------------------------------------------------------


def reference(plugins: Plugins) -> list[str]:
    """A page over all keys, in Markdown: of a run, then of each option of each group."""
    lines = [
        "# Configuration",
        "",
        "Every key, its value, what it may be, and what is written beside it where it is set. On the command line:",
        "`gsx KEY=VALUE`, `gsx GROUP=OPTION`, `gsx explain KEY`.",
    ]
    with Compositions(plugins) as compositions:
        groups = [group for group in known_groups() if listed(group)]
        lines += ["", "## Of a run", "", *keys_table("", [], compositions, groups)]
        for group in filter(LISTED.__contains__, groups):
            for option in listed(group):
                word = f"{group}=[{option}]" if group in SEVERAL else f"{group}={option}"
                lines += ["", f"## {word}", "", head_of(compositions.file(f"{group}/{option}")) + ".", ""]
                prefix = f"{SEVERAL[group]}.{option}" if group in SEVERAL else group.replace("/", ".")
                lines += keys_table(prefix, [word], compositions, groups)
    return [*lines, ""]


SEVERAL = {"augmenter": "augmenter", "tracker": "tracker", "module": "training"}
"""Where options lie of groups of which several are chosen."""
LISTED = ("scene", "backbone", *SEVERAL, "regenerator/upscale", "regenerator/restore", "rasterizer")
"""Groups whose options have keys of their own; presets and variants set those of others."""


def keys_table(prefix: str, words: Sequence[str], compositions: Compositions, groups: Sequence[str]) -> list[str]:
    """The keys below a prefix, a row each; those of a run where there is none, but not those that groups bring."""
    values = compositions.values(words)
    try:
        settings = compositions.settings(words)
    except ConfigError:  # an option that cannot be used before it is told more, a model for example
        settings = None
    files = parsed(compositions.sources(words))
    brought = tuple(f"{group.partition('/')[0]}." for group in groups)
    rows = ["| key | value | may be | |", "|---|---|---|---|"]
    for key in dotted(values):
        node = value_at(key, values)
        wanted = key.startswith(f"{prefix}.") if prefix else not key.startswith(brought)
        if wanted and not isinstance(node, dict):
            found = entries(files, key)
            comment = next((entry.comment for entry in reversed(found) if entry.comment), "")
            cells = (f"`{key}`", f"`{written(node)}`", kind_of(key, settings) if settings else "", comment)
            rows.append("| " + " | ".join(map(in_cell, cells)) + " |")
    return rows


def in_cell(text: str) -> str:
    """A text in a cell of a table, its marks shown as they are."""
    return re.sub(r"([|*])", r"\\\1", text) if "`" in text else re.sub(r"([|*_<>])", r"\\\1", text)
