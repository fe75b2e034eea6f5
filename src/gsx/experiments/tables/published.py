"""The paper's figures, as printed and as corrected; conf/published holds them, one file per table."""

import csv
import io
from dataclasses import dataclass
from importlib import resources

from gsx.core.errors import ConfigError, nearest

METRICS = {"PSNR": "PSNR", "SSIM": "SSIM", "LPIPS": "LPIPS", "kGS": "#GS(k)", "MB": "Mem(MB)"}
"""Columns of the files, and what the paper calls them."""


@dataclass(frozen=True, kw_only=True)
class Published:
    """One table of the paper."""

    name: str
    figures: dict[tuple[str, str, str], float]
    """By method, scope (dataset, scene, or group of views) and metric; corrected where the paper corrects itself."""
    notes: list[str]
    """Corrections."""

    @property
    def methods(self) -> list[str]:
        """Rows, in order."""
        return list(dict.fromkeys(method for method, _, _ in self.figures))

    @property
    def scopes(self) -> list[str]:
        """Datasets, scenes or groups, in order."""
        return list(dict.fromkeys(scope for _, scope, _ in self.figures))

    @property
    def metrics(self) -> list[str]:
        """Metrics, in order."""
        present = {metric for _, _, metric in self.figures}
        return [metric for metric in METRICS if metric in present]


def tables() -> list[str]:
    """Lists the names of the tables."""
    files = (resources.files("gsx.conf") / "published").iterdir()
    return sorted(file.name.removesuffix(".csv") for file in files if file.name != "errata.csv")


def read_table(name: str) -> Published:
    """Reads a table of the paper.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in tables():
        raise ConfigError(f"experiment.published is '{name}', no table of the paper.{nearest(name, tables())}")
    figures = {
        (line["method"], line["scope"], metric): float(line[metric])
        for line in lines_of(name)
        for metric in METRICS
        if line.get(metric)
    }
    notes = []
    for line in lines_of("errata"):
        if line["table"] == name:
            figures[line["method"], line["scope"], line["metric"]] = float(line["corrected"])
            metric = METRICS[line["metric"]]
            notes.append(
                f"{line['method']}, {line['scope']}: {metric} {line['corrected']}, printed as {line['printed']} "
                f"({line['source']})"
            )
    return Published(name=name, figures=figures, notes=notes)


def lines_of(name: str) -> list[dict[str, str]]:
    """Reads the lines of a file of conf/published."""
    text = (resources.files("gsx.conf") / "published" / f"{name}.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(io.StringIO(text)))
