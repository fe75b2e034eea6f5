"""Verbs that look: report, scenes, datasets, explain, plugins."""

import sys
from pathlib import Path

from gsx.builtin import plugins
from gsx.cli.arguments import Parser, new_folder
from gsx.core.errors import InputError, nearest
from gsx.engine.collector import loading


def verb_report(arguments: list[str]) -> int:
    """gsx report DIR [DIR ...] [--to FOLDER]"""
    parser = Parser(prog="gsx report", description="Report of a run, or one page over all runs of some folders.")
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="run, or folder with runs below it")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="folder for the page (DIR, or what several share)")
    options = parser.parse_args(arguments)
    with loading():
        from gsx.experiments.reports.report import report_on

    if options.to and options.to.exists():
        new_folder(options.to)  # or it is a file
    sys.stdout.write(f"{report_on(options.folders, options.to)}\n")
    return 0


def verb_scenes(arguments: list[str]) -> int:
    """gsx scenes PATH"""
    parser = Parser(
        prog="gsx scenes",
        description="What a folder is: format, cameras, images, points, problems, and how good the capture is.",
    )
    parser.add_argument("path", type=Path, metavar="PATH", help="folder of a scene")
    parser.add_argument(
        "--poses",
        action="store_true",
        help="find the poses of photographs that have none, which takes minutes, and judge the coverage",
    )
    options = parser.parse_args(arguments)
    with loading():
        from gsx.experiments.runs.inspect import describe

    lines = describe(options.path, plugins(), options.poses)
    sys.stdout.write("\n".join(lines) + "\n")
    return 2 if any(line.startswith("problem") for line in lines) else 0


def verb_datasets(arguments: list[str]) -> int:
    """gsx datasets [NAME ...] [data_root=FOLDER]"""
    parser = Parser(
        prog="gsx datasets",
        usage="%(prog)s [NAME ...] [data_root=FOLDER]",
        description="The paper's datasets: what is expected below data_root=FOLDER, what is found, what is missing.",
    )
    parser.add_argument("words", nargs="*", metavar="NAME", help="datasets (all)")
    arguments = parser.parse_args(arguments).words
    with loading():
        from gsx.experiments.runs.compose import Compositions, listed
        from gsx.experiments.tables.datasets import described

    overrides = [word for word in arguments if "=" in word]
    with Compositions(plugins()) as compositions:
        known = [name for name in listed("dataset") if name != "own"]
        names = [word for word in arguments if word not in overrides] or known
        for name in names:
            if name not in known:
                raise InputError(f"'{name}' is no dataset; there are {', '.join(known)}.{nearest(name, known)}")
            words = [f"dataset={name}", *overrides]
            root = Path(str(compositions.value(words, "data_root")))
            if any(word.startswith("data_root=") for word in overrides) and not root.is_dir():
                raise InputError(f"data_root={root} is no folder: give the one below which datasets lie")
            sys.stdout.write("\n".join(described(compositions.node(words, "dataset"), root)) + "\n")
    return 0


def verb_explain(arguments: list[str]) -> int:
    """gsx explain KEY [KEY=VALUE ...]"""
    description = "What a key of the configuration is, or a group: its value, what it may be, who says so, and why."
    parser = Parser(prog="gsx explain", usage="%(prog)s KEY [KEY=VALUE ...]", description=description)
    parser.add_argument(
        "key", metavar="KEY", help="for example training.supersampling.factor, backbone, backbone=scaffold"
    )
    parser.add_overrides("in this composition instead of the default")
    options = parser.parse_args(arguments)
    with loading():
        from gsx.experiments.runs.explain import explain

    sys.stdout.write("\n".join(explain(options.key, options.overrides, plugins())) + "\n")
    return 0


def verb_plugins(arguments: list[str]) -> int:
    """gsx plugins"""
    Parser(prog="gsx plugins", description="What is installed, from where, and what failed to load.").parse_args(
        arguments
    )
    with loading():
        from gsx.core.plugins import KINDS

        loaded = plugins()
    for kind in KINDS:
        parts = [f"{name} ({loaded.registry.find(kind, name).provider})" for name in loaded.registry.names(kind)]
        sys.stdout.write(f"{kind + ':':13} {', '.join(parts) or '-'}\n")
    for name, plugin_version in loaded.versions.items():
        sys.stdout.write(f"plugin {name} {plugin_version}\n")
    for failure in loaded.failures:
        sys.stdout.write(f"failed to load: {failure.plugin}: {failure.reason}\n")
    return 0
