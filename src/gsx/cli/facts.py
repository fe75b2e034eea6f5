"""Verbs that answer questions: report, scenes, datasets, explain, plugins."""

import sys
from argparse import Namespace
from collections.abc import Iterable
from pathlib import Path

from gsx.builtin import plugins
from gsx.core.errors import InputError, nearest
from gsx.core.files import expand_home
from gsx.core.plugins import KINDS
from gsx.experiments.download.get import get
from gsx.experiments.reports.report import report_on
from gsx.experiments.runs.compose import Compositions, listed
from gsx.experiments.runs.explain import explain
from gsx.experiments.runs.inspect import describe
from gsx.experiments.runs.settings import Dataset
from gsx.experiments.runs.typed import typed
from gsx.experiments.tables.datasets import described


def write_lines(lines: Iterable[str]) -> None:
    """Write lines to standard output."""
    sys.stdout.write("\n".join([*lines, ""]))


def report(options: Namespace) -> int:
    """Write the report of a run or of several and print its path."""
    if options.to and options.to.exists() and not options.to.is_dir():
        raise InputError(f"{options.to} is a file: choose another with --to FOLDER")
    write_lines([str(report_on(options.folders, options.to))])
    return 0


def check_scene(options: Namespace) -> int:
    """Print facts and problems of a scene's folder; return 2 if there are problems."""
    lines = describe(options.path, plugins(), options.poses)
    write_lines(lines)
    return 2 if any(line.startswith("problem") for line in lines) else 0


def datasets(options: Namespace) -> int:
    """Fetch one dataset, or print the folders of datasets that are there and those that are missing."""
    return get_dataset(options) if options.get else list_datasets(options)


def get_dataset(options: Namespace) -> int:
    """Fetch the scenes of a dataset that are missing, with `dataset.scene=SCENE` only that one."""
    place = [f"data_root={options.to}"] if options.to else []
    words = [f"dataset={options.get}", *options.words, *place]
    with Compositions(plugins()) as compositions:
        refuse_unknown_dataset(options.get, known_datasets())
        dataset = typed(Dataset, compositions.node(words, "dataset"), "dataset")
        root = expand_home(str(compositions.value(words, "data_root")))
    chosen = any(word.startswith("dataset.scene=") for word in words)
    scenes = [dataset.scene] if chosen else list(dataset.scenes)
    if dataset.scene not in dataset.scenes:
        raise InputError(f"Unknown scene '{dataset.scene}'. Choose from {', '.join(dataset.scenes)}")
    for line in get(dataset, root, scenes):
        write_lines([line])
        sys.stdout.flush()  # before a long download, also to a file
    return 0


def known_datasets() -> list[str]:
    """Return the names of datasets that name scenes."""
    return [name for name in listed("dataset") if name not in ("none", "own")]


def refuse_unknown_dataset(name: str, known: list[str]) -> None:
    """Raise InputError with the nearest name for a dataset that does not exist."""
    if name not in known:
        raise InputError(f"Unknown dataset '{name}'. Choose from {', '.join(known)}.{nearest(name, known)}")


def list_datasets(options: Namespace) -> int:
    """Print the folders of datasets that are there and those that are missing."""
    overrides = [word for word in options.words if "=" in word]
    with Compositions(plugins()) as compositions:
        known = known_datasets()
        for name in [word for word in options.words if "=" not in word] or known:
            refuse_unknown_dataset(name, known)
            words = [f"dataset={name}", *overrides]
            root = Path(str(compositions.value(words, "data_root")))
            if any(word.startswith("data_root=") for word in overrides) and not root.is_dir():
                raise InputError(f"data_root={root} is not a folder: give the folder that holds the datasets")
            write_lines(described(compositions.node(words, "dataset"), root))
    return 0


def explain_key(options: Namespace) -> int:
    """Print value, range, comment and source of a configuration key or group."""
    write_lines(explain(options.key, options.overrides, plugins()))
    return 0


def list_plugins(options: Namespace) -> int:
    """Print components by kind, plugins, and those that failed to load."""
    loaded = plugins()
    for kind in KINDS:
        parts = [f"{name} ({loaded.registry.find(kind, name).provider})" for name in loaded.registry.names(kind)]
        sys.stdout.write(f"{kind + ':':13} {', '.join(parts) or '-'}\n")
    write_lines([f"plugin {name} {version}" for name, version in loaded.versions.items()])
    write_lines([f"failed to load: {failure.plugin}: {failure.reason}" for failure in loaded.failures])
    return 0
