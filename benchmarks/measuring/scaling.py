"""How time and memory grow: with splats, resolution, overlap and tile size; and the table for a GPU."""

from collections.abc import Sequence

from measuring import rival
from measuring.bench import COLUMNS, Bench, Row, about_gsplat, compare, section
from measuring.cases import LARGEST, SMALLEST, Case
from measuring.limits import backward_bytes, bandwidths, best, forward_bytes, sizes_of
from measuring.results import Section

SMALL, FULL_HD = (648, 420), (1920, 1080)
NAIVE_SPLATS = 10_000
"""The naive loop is measured up to here, on small rasters; nothing is extrapolated."""
LINEAR_FROM = 10_000
"""Splats from which growth with pairs is judged; below, fixed costs rule."""
ABOUT_BANDWIDTH = (
    "Of bandwidth: the time that the least memory traffic of a sorting rasterizer takes at the best measured rate, "
    "{:,.0f} GB/s, over the time taken. Least traffic, forward: per splat 14 numbers read and a record of 9 written; "
    "per pair 8 bytes written, read and written by sorting, and read with the record; per pixel 4 numbers written. "
    "Backward: per pair 4 bytes and the record read, a gradient of 9 written and read; per splat 23 numbers read and "
    "written; per pixel 8 read. Four bytes a number; pairs of gsx's tiles."
)


def base(bench: Bench) -> Case:
    """What the other sections vary."""
    (width, height), splats = bench.pick((SMALL, 100_000), ((96, 64), 300))
    return Case(splats=splats, width=width, height=height)


def scale_splats(bench: Bench) -> Section:
    """1 k to 1 M splats of the same size in pixels, on two rasters."""
    rasters = bench.pick((SMALL, FULL_HD), ((96, 64), (128, 96)))
    counts = bench.pick((1_000, 10_000, 100_000, 1_000_000), (100, 300))
    rows = []
    for number, (width, height) in enumerate(rasters):
        for count in counts:
            case = Case(splats=count, width=width, height=height)
            rows += compare(bench, case, rivals=rivals(bench, naive=number == 0 and count <= NAIVE_SPLATS))
    return section(
        bench,
        "Splats",
        COLUMNS,
        rows,
        f"Splats of {SMALLEST:g} to {LARGEST:g} px (standard deviations) all over the raster. Medians, paths in turn; "
        "the first call compiles. MB: peak memory above the inputs, and of the whole process.",
        "The naive loop blends tile by tile with autograd; it is measured where it is small, and "
        "not extrapolated. It draws what cull=tight draws.",
        growth(rows),
        about_gsplat(bench),
    )


def rivals(bench: Bench, naive: bool) -> list[str]:
    """What is measured beside the paths."""
    return [*(["naive"] if naive else []), *([] if rival.missing(bench.device) else ["gsplat"])]


def growth(rows: Sequence[Row]) -> str:
    """Time per pair of the largest case in terms of that of the one where judging begins; 1 is linear."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row["splats"] >= LINEAR_FROM:
            groups.setdefault((row["path"], row["raster"]), []).append(row)
    parts = [f"{path} {raster}: {per_pair(group):.2f}" for (path, raster), group in groups.items() if len(group) > 1]
    return f"Time per pair at the most splats over that at {LINEAR_FROM:,}: {', '.join(parts)}." if parts else ""


def per_pair(rows: Sequence[Row]) -> float:
    """Time per pair in the last row over that in the first."""
    first, *_, last = (row["total_ms"] / row["pairs"] for row in rows)
    return last / first


def scale_resolution(bench: Bench) -> Section:
    """The same scene on ever finer rasters: its splats grow with them."""
    rows = []
    for factor in bench.pick((0.5, 1.0, 2.0, 3.0), (0.5, 1.0)):
        case = base(bench)
        width, height = round(case.width * factor), round(case.height * factor)
        rows += compare(bench, Case(splats=case.splats, width=width, height=height, size=factor))
    return section(
        bench, "TrainingViews", COLUMNS, rows, "The same scene on finer rasters; splats grow with them (size x)."
    )


def scale_overlap(bench: Bench) -> Section:
    """The same number of splats on the same raster, ever larger."""
    rows = []
    for factor in bench.pick((0.25, 0.5, 1.0, 2.0, 4.0), (0.5, 2.0)):
        case = base(bench)
        rows += compare(bench, Case(splats=case.splats, width=case.width, height=case.height, size=factor))
    return section(bench, "Overlap", COLUMNS, rows, f"Splats of {SMALLEST:g} to {LARGEST:g} px times size x.")


def scale_tiles(bench: Bench) -> Section:
    """The same picture from tiles of other sizes."""
    rows = []
    for tile in (4, 8, 16):
        rows += compare(bench, base(bench), [f"rasterizer.tile_size={tile}"])
    return section(bench, "Tile size", COLUMNS, rows, "The same picture; evaluations count whole tiles.")


def gpu_table(bench: Bench) -> Section:
    """100 k, 1 M and 3 M splats at 1080p against the memory-bandwidth limit."""
    width, height = bench.pick(FULL_HD, (128, 96))
    bandwidth = best(bandwidths(bench.device, sizes_of(bench.device, bench.quick)), "B/s")
    rows = []
    for count in bench.pick((100_000, 1_000_000, 3_000_000), (100, 300)):
        case = Case(splats=count, width=width, height=height)
        rows += [
            row | bandwidth_shares(row, case, bandwidth)
            for row in compare(bench, case, rivals=rivals(bench, naive=False))
        ]
    columns = [*COLUMNS, ["forward_share", "forward of bandwidth"], ["total_share", "both of bandwidth"]]
    return section(
        bench,
        f"1080p on {bench.device.type}" if not bench.quick else f"Quick on {bench.device.type}",
        columns,
        rows,
        ABOUT_BANDWIDTH.format(bandwidth / 1e9),
        about_gsplat(bench),
    )


def bandwidth_shares(row: Row, case: Case, bandwidth: float) -> Row:
    """Least time over time taken."""
    work = (case.splats, row["pairs"], case.width * case.height)
    forward, backward = forward_bytes(*work), backward_bytes(*work)
    return {
        "forward_share": 1e3 * forward / bandwidth / row["forward_ms"],
        "total_share": 1e3 * (forward + backward) / bandwidth / row["total_ms"],
    }
