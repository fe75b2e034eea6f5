"""A table as text: for the terminal, as CSV, Markdown and LaTeX."""

from collections.abc import Sequence

from gsx.core.files import csv_text
from gsx.experiments.evaluation.perceptual import METRICS as PERCEPTUAL
from gsx.experiments.tables.published import METRICS
from gsx.experiments.tables.table import Figure, Scope, Table, rows_of

DIGITS = {"detail": 3, "PSNR": 2, "SSIM": 3, "LPIPS": 3, "kGS": 0, "MB": 1, "s": 0}
FIELDS = (
    "row", "scope", "scenes", "of_scenes", "seeds", "metric", "ours", "spread", "paper", "difference", "gain",
    "gain_spread", "paper_gain", "problem", "remarks",
)  # fmt: skip


def number(value: float | None, metric: str, sign: bool = False) -> str:
    """Formats a figure, if there is one, with the paper's decimals; with a sign where it is a difference."""
    name = metric.partition(" x")[0]
    digits = DIGITS.get(name, 3 if name in PERCEPTUAL else 2)
    return "" if value is None else f"{value:{'+' if sign else ''}.{digits}f}"


def ours(figure: Figure) -> str:
    """Formats our figure with its spread; in brackets where scenes are missing, with a star where it has a note."""
    if figure.ours is None:
        return "-"
    text = number(figure.ours, figure.metric)
    if figure.spread is not None:
        text += f" ± {number(figure.spread, figure.metric)}"
    text += " *" if figure.remarks else ""
    return text if figure.scenes == figure.of_scenes else f"({text}: {figure.scenes} of {figure.of_scenes})"


def headings(table: Table, scope: Scope) -> list[tuple[str, str]]:
    """Lists (metric, what of it) of each column."""
    columns = []
    for metric in metrics_of(table, scope):
        columns.append((metric, "ours"))
        if any(table.at(row, scope.title, metric).paper is not None for row in rows_of(table.experiment)):
            columns += [(metric, "paper"), (metric, "difference")]
    return columns


def metrics_of(table: Table, scope: Scope) -> list[str]:
    """Lists the metrics with figures in this scope, ours or the paper's."""

    def has_figures(metric: str) -> bool:
        figures = [table.at(row, scope.title, metric) for row in rows_of(table.experiment)]
        return any(f.ours is not None or f.paper is not None for f in figures)

    return [metric for metric in table.metrics if has_figures(metric)]


def cells(table: Table, scope: Scope) -> list[list[str]]:
    """Returns the grid of a scope: headings, then rows; with gains in the first metric over the baseline."""
    columns, lead = headings(table, scope), next(iter(metrics_of(table, scope)), "")
    head = ["", *(f"{METRICS.get(m, m)} {what}" if what == "ours" else what for m, what in columns)]
    gains = ["gain", "gain in the paper"] if lead else []
    rows = []
    for row in rows_of(table.experiment):
        line = [row]
        for metric, what in columns:
            f = table.at(row, scope.title, metric)
            values = {"paper": number(f.paper, metric), "difference": number(f.difference, metric, sign=True)}
            line.append(ours(f) if what == "ours" else values[what])
        if lead:
            f = table.at(row, scope.title, lead)
            varied = number(f.gain_spread, lead)
            gain = number(f.gain, lead, sign=True) + (f" ± {varied}" if varied else "")
            line += [gain, number(f.paper_gain, lead, sign=True)]
        rows.append(line)
    return [[*head, *gains], *rows]


def problems(table: Table) -> list[str]:
    """Lists why figures are missing: each reason once, with its rows."""
    rows: dict[str, list[str]] = {}
    for f in table.figures:
        if f.problem and f.row not in table.experiment.quoted and f.row not in rows.setdefault(f.problem, []):
            rows[f.problem].append(f.row)
    everything = len(table.experiment.chosen)
    return [f"{reason}: {'all rows' if len(r) == everything else ', '.join(r)}" for reason, r in rows.items()]


def face(table: Table) -> list[str]:
    """Returns title and warnings, above all figures."""
    lines = [table.experiment.title]
    if table.foreign:
        lines.append(f"NOT the paper's protocol: {'; '.join(table.foreign)}")
    return lines


def foot(table: Table) -> list[str]:
    """Lists the notes below the figures."""
    states = ", ".join(f"{count} {state}" for state, count in table.states.items())
    baseline = table.experiment.baseline
    absent = "" if baseline in table.experiment.chosen else ", which is not run: there are none of ours"
    lines = [f"runs: {states}", f"gains are over {baseline}{absent}"]
    seeds = table.experiment.seeds
    if len(seeds) > 1:
        lines.append(f"means over {len(seeds)} seeds, ± half of their range")
    if table.saved:
        lines.append(
            f"{table.saved:,.0f} s of training saved by common beginnings, {table.seconds:,.0f} s taken "
            f"({100 * table.saved / (table.saved + table.seconds):.0f} % less)"
        )
    return [*lines, *table.notes, *problems(table)]


def as_text(table: Table) -> str:
    """Formats the table for the terminal."""
    blocks = ["\n".join(face(table))]
    for scope in table.scopes:
        grid = cells(table, scope)
        blocks.append("\n".join([title_of(scope), *aligned(grid)]))
    return "\n\n".join([*blocks, "\n".join(foot(table))]) + "\n"


def title_of(scope: Scope) -> str:
    """Returns the title of a scope, and the paper's where that is another one."""
    paper = f", {scope.paper} in the paper" if scope.paper and scope.paper != scope.title else ""
    count = f" ({len(scope.scenes)} scenes)" if len(scope.scenes) > 1 else ""
    return f"{scope.title}{count}{paper}"


def aligned(grid: Sequence[Sequence[str]]) -> list[str]:
    """Aligns columns, figures to the right."""
    widths = [max(len(line[i]) for line in grid) for i in range(len(grid[0]))]
    padded = [[line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])] for line in grid]
    return ["  ".join(words).rstrip() for words in padded]


def as_csv(table: Table) -> str:
    """Formats the table as CSV, a line for each figure; missing ones are empty."""
    return csv_text(
        FIELDS, ({key: getattr(f, key) for key in FIELDS} | {"remarks": "; ".join(f.remarks)} for f in table.figures)
    )


def as_markdown(table: Table) -> str:
    """Formats the table as Markdown."""
    title, *warnings = face(table)
    blocks = [f"# {title}", *(f"**{warning}**" for warning in warnings)]
    for scope in table.scopes:
        head, *rows = cells(table, scope)
        rule = "|".join(["---", *("--:" for _ in head[1:])])
        lines = [f"| {' | '.join(line)} |" for line in [head, *rows]]
        blocks.append("\n".join([f"## {title_of(scope)}", "", lines[0], f"|{rule}|", *lines[1:]]))
    return "\n\n".join([*blocks, "\n".join(f"* {line}" for line in foot(table))]) + "\n"


def as_latex(table: Table) -> str:
    """Formats the table as LaTeX: one tabular for each scope, with package booktabs."""
    title, *warnings = face(table)
    out = [f"% {line}" for line in [title, *warnings]]
    for scope in table.scopes:
        head, *rows = cells(table, scope)
        caption = ". ".join(escaped(text) for text in [title, title_of(scope), *warnings])
        body = [" & ".join(escaped(word) for word in line) + r" \\" for line in rows]
        out += [
            r"\begin{table}",
            rf"\caption{{{caption}.}}",
            rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}",
            r"\toprule",
            " & ".join(escaped(word) for word in head) + r" \\",
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
        ]
    return "\n".join(out) + "\n"


def escaped(text: str) -> str:
    """Escapes LaTeX's special characters."""
    for character in "\\&%$#_{}":
        text = text.replace(character, r"\textbackslash " if character == "\\" else f"\\{character}")
    return text.replace("±", r"$\pm$").replace("~", r"\textasciitilde ").replace("^", r"\textasciicircum ")
