"""Blending against what the machine can do at best."""

import torch

from gsx.core.rasterizer.projection import project
from measuring.adapter import LOOPS, count_pairs, loops_timed, pair_screen, settings_of
from measuring.bench import Bench, Row, section
from measuring.cases import blending, camera_of, gradient_of, splats_of
from measuring.limits import BACKWARD_FLOPS, FORWARD_FLOPS, Limit, best, evaluation_limit, measured_limits, sizes_of
from measuring.results import Section
from measuring.scaling import base
from measuring.watches import Job, Timing, rounds_of, take_turns, timed

ABOUT_SHARES = (
    "Of exp: evaluations over exponentials per second. Of exp + flops: over what one exponential and then the "
    "arithmetic would allow at the best of the measured rates; above 1, alphas are got with less than torch's "
    "exponential. Blending lists, tables and pictures apart: the loops over blocks alone. Operations per evaluation:"
)
ALONE = "compiled loops over blocks alone"
FLOPS = {"forward": sum(FORWARD_FLOPS.values()), "backward": sum(BACKWARD_FLOPS.values())}


def limits_section(bench: Bench) -> Section:
    """Measured limits, then alpha evaluations per second as shares of them."""
    limits = measured_limits(bench.device, sizes_of(bench.device, bench.quick), "compiled" in bench.paths)
    rows = [{"what": limit.name, "rate": limit.rate / 1e9, "unit": f"G{limit.unit}"} for limit in limits]
    timings, evaluations = time_blending(bench)
    for phase in FLOPS:
        rows += [rate_row(path, phase, timing, evaluations[path], limits) for path, timing in timings.items()]
    columns = [["what", "what"], ["rate", "rate"], ["unit", "unit"], ["of_exp", "of exp"], ["of_all", "of exp + flops"]]
    counts = "; ".join(f"{phase} {flops} besides the exponential" for phase, flops in FLOPS.items())
    case = base(bench)
    return section(
        bench,
        "Limits",
        columns,
        rows,
        f"Fastest of repeated calls, float32, {torch.get_num_threads()} threads; B/s count bytes read and written.",
        f"Blending, without pairing and projection, of {case.splats:,} splats on {case.raster}. {ABOUT_SHARES} "
        f"{counts}.",
    )


def time_blending(bench: Bench) -> tuple[dict[str, Timing], dict[str, int]]:
    """Times of the blending of the usual case by each path, and its alpha evaluations."""
    case = base(bench)
    camera, gradient = camera_of(case), gradient_of(case, bench.device)
    jobs, evaluations = {}, {}
    for path in bench.paths:
        settings = settings_of(path)
        with torch.no_grad():
            screen = project(splats_of(case, bench.device), camera, settings)
        jobs[path] = blending(screen, camera, settings, gradient)
        evaluations[path] = count_pairs(pair_screen(screen, camera, settings)) * settings.tile_size**2
    timings = take_turns(jobs, bench.device, bench.patience)
    if bench.device.type == "cpu" and "compiled" in jobs:
        timings[ALONE], evaluations[ALONE] = loops_of(jobs["compiled"], bench), evaluations["compiled"]
    return timings, evaluations


def loops_of(job: Job, bench: Bench) -> Timing:
    """What of the phases of a job by the compiled path is spent in its loops over blocks."""
    rounds = []
    for _ in rounds_of(bench.patience):
        with loops_timed() as spent:
            timed(job, bench.device)
        rounds.append({phase: 1e3 * sum(spent[name] for name in names) for phase, names in LOOPS.items()})
    return Timing(sum(rounds[0].values()), rounds)


def rate_row(path: str, phase: str, timing: Timing, evaluations: int, limits: list[Limit]) -> Row:
    """Evaluations per second of a phase and their shares of the limits."""
    rate = 1e3 * evaluations / timing.median(phase)
    return {
        "what": f"{phase}, {path}",
        "rate": rate / 1e9,
        "unit": "G evaluations/s",
        "of_exp": rate / best(limits, "exp/s"),
        "of_all": rate / evaluation_limit(limits, FLOPS[phase]),
    }
