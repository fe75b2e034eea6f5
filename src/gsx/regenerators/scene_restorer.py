"""A restorer learnt from this scene: it repairs renders of places that no photograph shows.

Two networks learn from half of the training views each, rendered by a model that was not fitted to them. The network
that has not learnt from a training view restores pictures made near it, so that none answers from memory.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, max_pool2d, pad

from gsx.core.data.scene import View
from gsx.core.errors import InputError
from gsx.core.ranges import Interval, Range, Rate
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Float
from gsx.core.training.regenerator import RegeneratorContext, Request
from gsx.regenerators.classical import refuse_enlarging
from gsx.regenerators.networks import (
    Pair,
    fit,
    held_out_pairs,
    initialise,
    mean_square,
    random_part,
    read_tensors,
    with_own,
    write_tensors,
)

logger = logging.getLogger(__name__)

FOLDS = 2
LARGEST_CHANGE = 32 / 255  # of a display value


@dataclass(frozen=True, kw_only=True)
class RestorerOptions:
    """Options of conf/regenerator/restore/scene_restorer.yaml."""

    name: str
    channels: Annotated[int, Range(1, 1024)]
    steps: Interval
    """Steps at the first event of a run."""
    later_steps: Interval
    """Steps at each later event at which it learns on."""
    again: Annotated[float, Range(1, 1000)]
    """It learns again at the first event at which the run is this many times as long as at the last time."""
    halves: Annotated[float, Range(0, 100)] = 0.35
    """Share of the run's steps so far that the models of half of the views train. The default: older runs."""
    batch: Annotated[int, Range(1, 4096)]
    crop: Annotated[int, Range(16, 4096)]
    """Edge of a training crop, px."""
    rate: Rate

    def __post_init__(self) -> None:
        if not (self.rate > 0 and self.halves > 0):
            raise ValueError("regenerator.restore: rate and halves must be above 0")


class Residual(nn.Module):
    """A network of three scales whose output is added to its input; at first that is 0."""

    def __init__(self, channels: int, generator: torch.Generator) -> None:
        super().__init__()
        c = channels
        self.down = nn.ModuleList([block(3, c), block(c, 2 * c), block(2 * c, 4 * c)])
        self.up = nn.ModuleList([block(6 * c, 2 * c), block(3 * c, c)])
        self.last = nn.Conv2d(c, 3, 3, padding=1)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                initialise(layer, generator)
        nn.init.zeros_(self.last.weight)

    def forward(self, image: Float[Tensor, "B 3 h w"]) -> Float[Tensor, "B 3 h w"]:
        """Return the change of each value, at most LARGEST_CHANGE."""
        height, width = image.shape[2:]
        padded = pad(image - 0.5, (0, -width % 4, 0, -height % 4), mode="replicate")
        fine = self.down[0](padded)
        middle = self.down[1](max_pool2d(fine, 2))
        coarse = self.down[2](max_pool2d(middle, 2))
        middle = self.up[0](torch.cat([interpolate(coarse, scale_factor=2), middle], 1))
        fine = self.up[1](torch.cat([interpolate(middle, scale_factor=2), fine], 1))
        return LARGEST_CHANGE * torch.tanh(self.last(fine)[:, :, :height, :width])


def block(inputs: int, outputs: int) -> nn.Sequential:
    """Return two convolutions with SiLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1), nn.SiLU(), nn.Conv2d(outputs, outputs, 3, padding=1), nn.SiLU()
    )


def restored(network: Residual, image: Float[Tensor, "3 h w"], share: float = 1) -> Float[Tensor, "3 h w"]:
    """Add a share of the network's change to a picture."""
    image = image.to(next(network.parameters()).device)
    return (image + share * network(image[None])[0]).clamp(0, 1)


class SceneRestorer:
    """Two networks that learn at the first event of a run, and learn on at some later ones."""

    def __init__(self, options: RestorerOptions) -> None:
        self.options = options
        self.networks: list[Residual] = []
        self.useful = [False] * FOLDS
        self.prepared = -1
        """Step at which they were prepared last."""

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raise ConfigError for a scale above 1, InputError for too few views."""
        refuse_enlarging("scene_restorer", scales)
        if len(views) < 2 * FOLDS:
            needed = f"needs at least {2 * FOLDS} training views, there are {len(views)}"
            raise InputError(f"regenerator scene_restorer {needed}: choose regenerator/restore=identity")

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Train each network on held-out renders of half of the views, and measure it on those of the other half.

        A network that has become worse there returns to its former weights. One that brings them no closer to their
        photographs is not used.
        """
        if self.prepared == context.step:  # another augmenter uses it at this event
            return {}
        earlier = self.earlier(context)
        if not self.networks:
            self.networks, self.useful = self.recalled(context, earlier)
        self.prepared = context.step
        if earlier and context.step < self.options.again * event_of(earlier[-1]):
            return {}
        steps = self.options.later_steps if earlier else self.options.steps
        pairs = held_out_pairs(context, self.options.halves)
        metrics: dict[str, float] = {}
        for fold, network in enumerate(self.networks):
            own = with_own(pairs, context, range(fold, len(pairs), FOLDS))
            others = [pair for number, pair in enumerate(pairs) if number % FOLDS != fold]
            renders, before = mean_square(others), mean_error(network, others)
            former = {name: value.clone() for name, value in network.state_dict().items()}
            learn(network, own, self.options, steps, fold, context)
            after = mean_error(network, others)
            if after > before:
                network.load_state_dict(former)
            self.useful[fold] = min(before, after) < renders
            metrics |= {f"error_of_renders_{fold}": renders, f"error_restored_{fold}": min(before, after)}
        if not any(self.useful):
            logger.warning("scene_restorer brings held-out renders no closer to their photographs: it changes nothing")
        self.keep(context)
        return metrics

    @torch.no_grad()
    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 h w"]]:
        """Restore each picture by the network that has not learnt from its view, in proportion to the strength."""
        return [self.restored(request) for request in requests]

    def restored(self, request: Request) -> Float[Tensor, "3 h w"]:
        """Restore a picture; the strongest event of a run applies the whole change."""
        fold = (request.number + 1) % FOLDS
        if not self.useful[fold] or request.strength == 0:
            return request.image
        return restored(self.networks[fold], request.image, request.strength / request.strongest)

    def keep(self, context: RegeneratorContext) -> None:
        """Write both networks into the run's folder, as one file for each event at which they learn."""
        tensors = {
            f"{n}.{name}": value for n, one in enumerate(self.networks) for name, value in one.state_dict().items()
        }
        path = context.folder / f"scene_restorer_{context.step:07d}.safetensors"
        write_tensors(path, tensors | {"useful": torch.tensor(self.useful)})

    def earlier(self, context: RegeneratorContext) -> list[Path]:
        """Return the files of the run's events before this one, oldest first."""
        files = sorted(context.folder.glob("scene_restorer_*.safetensors"))
        return [path for path in files if event_of(path) < context.step]

    def recalled(self, context: RegeneratorContext, earlier: Sequence[Path]) -> tuple[list[Residual], list[bool]]:
        """Return (networks, whether each is of use) of the latest event, or new ones; InputError: another size."""
        seeds = [derived_seed(context.seed, fold) for fold in range(FOLDS)]
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        networks = [Residual(self.options.channels, generator).to(context.device) for generator in generators]
        found = read_tensors(earlier[-1]) if earlier else None
        if found is None:
            return networks, [False] * FOLDS
        useful = found.pop("useful", torch.zeros(FOLDS, dtype=torch.bool)).tolist()
        try:
            nn.ModuleList(networks).load_state_dict(found)
        except RuntimeError as error:
            raise InputError(
                f"{earlier[-1]} holds networks of another size ({str(error).splitlines()[0]}): use the "
                "regenerator.restore options with which the run began"
            ) from error
        return networks, useful


def event_of(path: Path) -> int:
    """Return the step of a file's event."""
    return int(path.stem.rpartition("_")[2])


def learn(
    network: Residual,
    pairs: Sequence[Pair],
    options: RestorerOptions,
    steps: int,
    fold: int,
    context: RegeneratorContext,
) -> None:
    """Train on crops; loss: L1 plus a tenth of the L1 of differences of neighbours."""
    generator = torch.Generator().manual_seed(derived_seed("crops", context.seed, context.step, fold))
    device = next(network.parameters()).device

    def loss_of() -> Tensor:
        render, photo = (part.to(device) for part in batch(pairs, options, generator))
        out = render + network(render)
        colours = (out - photo).abs().mean()  # before slopes: autograd adds gradients in this order
        return colours + 0.1 * sum((out.diff(dim=axis) - photo.diff(dim=axis)).abs().mean() for axis in (2, 3))

    fit(network, loss_of, context, steps, options.rate)


def batch(pairs: Sequence[Pair], options: RestorerOptions, generator: torch.Generator) -> Pair:
    """Stack crops at the same places of renders and photographs, mirrored at random."""
    edge = min(options.crop, *(min(photo.shape[1:]) for _, photo in pairs))
    parts = [random_part(pairs, (edge, edge), generator) for _ in range(options.batch)]
    renders, photos = zip(*parts, strict=True)
    return torch.stack(renders), torch.stack(photos)


@torch.no_grad()
def mean_error(network: Residual, pairs: Sequence[Pair]) -> float:
    """Return the mean squared error of restored renders."""
    return mean_square((restored(network, render).cpu(), photo) for render, photo in pairs)
