"""How fast the rasterizer is, what it needs, and how near it comes to what the machine can do.

    python benchmarks/rasterizer.py                            # everything that needs no further files
    python benchmarks/rasterizer.py --only splats,limits       # some sections
    python benchmarks/rasterizer.py --quick                    # tiny sizes, to see that everything works
    python benchmarks/rasterizer.py --only step --run RUN      # training steps of a run folder from its checkpoint on
    python benchmarks/rasterizer.py --device cuda --paths compiled --only truth,gpu,step   # some minutes on a GPU

Prints tables; writes JSON, Markdown and a plot to benchmarks/results. Sections measured earlier are kept there, each
with its machine. Measure alone: on a busy machine two threads can be tens of times slower.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from gsx.core.errors import GsxError, InputError, nearest
from gsx.engine.allocator import keep_freed_memory
from gsx.experiments.runs.build import choose_device
from measuring import adapter
from measuring.bench import Bench, say
from measuring.ceiling import limits_section
from measuring.machine import BUSY, describe_machine, load_average, shown_command
from measuring.memory import unmeasurable
from measuring.prototype import prototype_section
from measuring.results import Section, read_sections, text_table, write_results
from measuring.scaling import gpu_table, scale_overlap, scale_resolution, scale_splats, scale_tiles
from measuring.steps import step_section
from measuring.truth import truth_section
from measuring.watches import Patience

SECTIONS: dict[str, Callable[[Bench], Section]] = {
    "truth": truth_section,
    "limits": limits_section,
    "splats": scale_splats,
    "resolution": scale_resolution,
    "overlap": scale_overlap,
    "tile": scale_tiles,
    "prototype": prototype_section,
    "step": step_section,
    "gpu": gpu_table,
}
PATHS = ("eager", "compiled")
RESULTS = Path(__file__).parent / "results"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--only", type=names_in, default=(), metavar="A,B", help=f"sections: {', '.join(SECTIONS)}")
    made.add_argument("--paths", type=names_in, default=PATHS, metavar="A,B", help="eager,compiled (both)")
    made.add_argument("--quick", action="store_true", help="tiny sizes; results get the suffix _quick")
    made.add_argument("--device", default="cpu", help="cpu or cuda (cpu)")
    made.add_argument("--threads", type=int, default=torch.get_num_threads(), help="threads (as torch chooses)")
    made.add_argument("--repeats", type=int, default=7, help="timed calls of each path and case (7)")
    made.add_argument(
        "--patience", type=float, default=60, metavar="S", help="after S seconds a case gets 3 calls (60)"
    )
    made.add_argument("--memory", action=argparse.BooleanOptionalAction, default=True, help="measure peak memory (yes)")
    made.add_argument("--prototype", type=Path, metavar="FILE", help="composite.py of the prototype, to compare with")
    made.add_argument("--run", type=Path, metavar="RUN", help="run folder for the section step (the built-in scene)")
    made.add_argument(
        "--to", type=Path, default=RESULTS, metavar="FOLDER", help="where results go (benchmarks/results)"
    )
    return made


def names_in(text: str) -> tuple[str, ...]:
    """Words between commas."""
    return tuple(word for word in text.split(",") if word)


def known(chosen: Sequence[str], options: Sequence[str], flag: str) -> None:
    """Raise InputError for a name that is none of the options."""
    for name in chosen:
        if name not in options:
            raise InputError(f"{flag} has no '{name}'.{nearest(name, options)} Choose from {', '.join(options)}")


def usable_paths(wanted: Sequence[str], device: torch.device) -> tuple[str, ...]:
    """Those that can be measured; says why others cannot.

    Raises:
        InputError: none can.
    """
    reasons = {path: adapter.missing(path, device) for path in wanted}
    for path, reason in reasons.items():
        if reason:
            say(f"warning: {path} is not measured: {reason}")
    usable = tuple(path for path, reason in reasons.items() if not reason)
    if not usable:
        raise InputError("no path is left to measure: give --paths eager")
    return usable


def chosen_sections(given: argparse.Namespace) -> list[str]:
    """Those asked for, else all that this run can measure."""
    known(given.only, list(SECTIONS), "--only")
    left_out = {"prototype"} if given.device == "cuda" or not given.prototype else set()
    left_out |= {"gpu"} if given.device == "cpu" else set()
    return list(given.only) or [name for name in SECTIONS if name not in left_out]


def bench_of(given: argparse.Namespace, command: str) -> Bench:
    """What the command line asks for.

    Raises:
        GsxError: a value is wrong.
    """
    known(given.paths, PATHS, "--paths")
    if given.threads < 1 or given.repeats < 1:
        raise InputError(f"--threads {given.threads} and --repeats {given.repeats} must be at least 1")
    torch.set_num_threads(given.threads)
    device = choose_device(given.device)
    reason = unmeasurable(device)
    if reason and given.memory:
        say(f"warning: peak memory is not measured: {reason}")
    return Bench(
        device=device,
        paths=usable_paths(given.paths, device),
        patience=Patience(2 if given.quick else given.repeats, given.patience),
        memory=given.memory and not reason,
        quick=given.quick,
        load=load_average(),
        command=command,
        prototype=given.prototype,
        run=given.run,
    )


def warn_if_busy(load: float) -> None:
    """Say the load before anything is measured."""
    say(f"load average {load:g}")
    if load > BUSY:
        say(f"warning: other work is running (load {load:g}): times will be too long, and ratios may be wrong")


def measure(given: argparse.Namespace, command: str) -> None:
    """Measure and write section by section, so that nothing is lost when one fails."""
    names, bench = chosen_sections(given), bench_of(given, command)
    warn_if_busy(bench.load)
    machine = describe_machine(bench.device)
    say(", ".join(f"{key} {value}" for key, value in machine.items()))
    result = f"rasterizer_{bench.device.type}{'_quick' if given.quick else ''}"
    read_sections(given.to / f"{result}.json")  # what cannot be added to is refused now, not after measuring
    written: list[Path] = []
    for name in names:
        say(f"{name} ...")
        section = SECTIONS[name](bench)
        sys.stdout.write(text_table(section) + "\n")
        sys.stdout.flush()
        written = write_results(given.to, result, machine, {name: section})
    say("written: " + ", ".join(map(str, written)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; 0 when everything was measured, 2 when there is something for the user to mend."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        measure(parser().parse_args(words), shown_command(words))
    except GsxError as error:
        say(f"benchmark: {error}")
        return 2
    return 0


if __name__ == "__main__":
    keep_freed_memory()  # as runs do
    sys.exit(main())
