"""Perceptual figures of an evaluation: metrics by name. A metric whose weights are not installed has no figure."""

import logging
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import torch
from torch import Tensor

from gsx.core.data.masks import black_out
from gsx.core.data.scene import View
from gsx.core.shapes import Float
from gsx.experiments.evaluation.chosen_views import evenly
from gsx.experiments.evaluation.feature_distance import FeatureDistance, WindowedDistance
from gsx.experiments.evaluation.lpips import lpips_from
from gsx.experiments.evaluation.niqe import niqe_of
from gsx.experiments.evaluation.st_lpips import shift_tolerant_lpips
from gsx.experiments.evaluation.weights import InstalledWeights, MetricUnavailable, installed_weights
from gsx.experiments.evaluation.zoomed import Zoomed

logger = logging.getLogger(__name__)

Picture: TypeAlias = Float[Tensor, "3 H W"]
Figures: TypeAlias = dict[str, dict[str, float]]
"""Figures by metric and by picture."""
COMPARED = ("render", "enlarged", "upscaled")
"""Pictures of a zoom that are compared with the truth, as far as there are any."""


class Metric(Protocol):
    """Perceptual metric; lower is better."""

    least: int
    """Edge of the smallest picture that is measured, px."""

    def distances(self, images: Sequence[Picture], target: Picture) -> list[float]:
        """Computes the figure of each picture."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class NamedMetric:
    """A metric and where it comes from."""

    metric: Metric
    provenance: dict[str, Any]


NETWORKS: dict[str, Callable[[InstalledWeights, str], FeatureDistance]] = {
    "st_lpips_alex": lambda weights, _: shift_tolerant_lpips("alex", weights.tensors["weights"]),
    "st_lpips_vgg": lambda weights, _: shift_tolerant_lpips("vgg", weights.tensors["weights"]),
    "lpips_alex": lambda weights, signed: lpips_from("alex", signed, **weights.tensors),
    "lpips_vgg": lambda weights, signed: lpips_from("vgg", signed, **weights.tensors),
}
"""Networks by the name of the metric, from their weights and `metrics.lpips.input_range`."""
METRICS = (*NETWORKS, "niqe")
"""Names of `metrics.perceptual`."""
NIQE = "NIQE (Mittal et al. 2013), statistics of the scene's training photos"
NIQE_PHOTOS = 100
"""Most training photos whose patches make NIQE's statistics."""


class PerceptualMetrics:
    """The metrics of an evaluation."""

    def __init__(self, names: Sequence[str], metrics: Mapping[str, NamedMetric]) -> None:
        self.names, self.metrics = names, metrics
        """Requested names, and the metrics that can be measured."""

    @property
    def provenance(self) -> dict[str, Any]:
        """Returns name, licence, and version and hash of the weights, of each metric that is measured."""
        return {"perceptual_metrics": {name: one.provenance for name, one in self.metrics.items()}}

    def compare(self, pictures: Mapping[str, Picture], target: Picture) -> Figures:
        """Measures pictures against a target by each metric that pictures of that size have; finite figures only."""
        measurable = {
            name: one.metric for name, one in self.metrics.items() if min(target.shape[1:]) >= one.metric.least
        }
        found: Figures = {}
        for name, metric in measurable.items():
            values = zip(pictures, metric.distances(list(pictures.values()), target), strict=True)
            found[name] = {picture: value for picture, value in values if math.isfinite(value)}
        return found

    def view(self, image: Picture, target: Picture) -> dict[str, float]:
        """Measures a render at the training resolution by each metric."""
        figures = self.compare({"render": image}, target)
        return {name: values["render"] for name, values in figures.items() if values}

    def zoomed(self, zoomed: Zoomed, part: Callable[[Picture], Picture]) -> Figures:
        """Measures the pictures of a zoom by each metric; `part`: cuts what is evaluated out of a picture."""
        compared = {name: part(picture) for name, picture in zoomed.pictures(COMPARED).items()}
        return self.compare(compared, part(zoomed.truth)) if self.metrics else {}

    def summary(self, views: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float | None]]:
        """Returns the mean of each requested metric over views; None where it is not measured."""
        figures = [view["perceptual"] for view in views]
        return {"perceptual": {name: mean_of([one[name] for one in figures if name in one]) for name in self.names}}


def mean_of(values: Sequence[float | None]) -> float | None:
    """Returns the mean; None: a value is missing, or there are none."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known and len(known) == len(values) else None


def at_training_size(view: Mapping[str, float]) -> Figures:
    """Returns the figures of a view at the training resolution as those of a zoom, where nothing is enlarged."""
    return {name: {"render": value, "enlarged": value} for name, value in view.items()}


def zoom_means(views: Sequence[Figures]) -> dict[str, Figures]:
    """Returns mean figures over views under the key `perceptual`; empty where nothing was measured.

    Pictures that some of the measured views lack are left out, so that means of a metric are over the same views.
    """
    means: Figures = {}
    for metric in dict.fromkeys(metric for view in views for metric in view):
        measured = [view[metric] for view in views if view.get(metric)]
        shared = [name for name in COMPARED if measured and all(name in pictures for pictures in measured)]
        if shared:
            means[metric] = {name: statistics.fmean(pictures[name] for pictures in measured) for name in shared}
    return {"perceptual": means} if means else {}


@dataclass(frozen=True, eq=False, kw_only=True)
class MetricSettings:
    """Inputs of metrics besides their weights."""

    input_range: str
    """Range of values that LPIPS gets, `metrics.lpips.input_range`."""
    pixels: int
    """Largest picture that networks measure as a whole, 0: any."""
    device: torch.device
    photos: Sequence[View] = ()
    """Training views, whose photos NIQE takes for natural."""


def load_metrics(names: Sequence[str], settings: MetricSettings) -> PerceptualMetrics:
    """Loads metrics by name, with a log line for each that cannot be measured."""
    return PerceptualMetrics(names, dict(loadable(names, settings)))


def loadable(names: Sequence[str], settings: MetricSettings) -> Iterator[tuple[str, NamedMetric]]:
    """Yields the metrics that can be measured on this machine."""
    for name in names:
        try:
            yield name, network_metric(name, settings) if name in NETWORKS else niqe_metric(settings.photos)
        except MetricUnavailable as error:
            logger.info("%s is not measured: %s", name, error)


def network_metric(name: str, settings: MetricSettings) -> NamedMetric:
    """Loads a network with its weights."""
    weights, pixels = installed_weights(name), settings.pixels
    network = NETWORKS[name](weights, settings.input_range).to(settings.device)
    details = {"input": network.input, "windows": f"four, of pictures above {pixels} px" if pixels else "none"}
    return NamedMetric(metric=WindowedDistance(network, pixels), provenance=weights.provenance | details)


def niqe_metric(views: Sequence[View]) -> NamedMetric:
    """Builds NIQE from the photos of up to NIQE_PHOTOS training views."""
    chosen = evenly(views, NIQE_PHOTOS)
    metric, patches = niqe_of(black_out(view.image(), view.counted()) for view in chosen)
    source = f"{patches} sharp patches of {len(chosen)} training photos of this scene"
    return NamedMetric(metric=metric, provenance={"metric": NIQE, "statistics": source})
