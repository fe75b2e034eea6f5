"""A restorer learnt from this scene: what photographs have that renders lack of places nobody photographed.

Two networks learn from half of the training views each, rendered by a model that was not fitted to them. A picture made
beside a training view is restored by the one that has not seen that view, so that neither can answer from memory.
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
from gsx.core.files import replace_file
from gsx.core.ranges import Interval, Range, Rate
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Float
from gsx.core.training.regenerator import RegeneratorContext, Request
from gsx.regenerators.classical import refuse_enlarging
from gsx.regenerators.pairs import Pair, held_out_pairs, mean_square, random_part, with_own
from gsx.regenerators.scene_sr import begin, read_network

logger = logging.getLogger(__name__)

FOLDS = 2
LARGEST_CHANGE = 32 / 255
"""Of a display value."""


@dataclass(frozen=True, kw_only=True)
class RestorerOptions:
    """Options; values in conf/regenerator/restore/scene_restorer.yaml."""

    name: str
    channels: Annotated[int, Range(1, 1024)]
    steps: Interval
    """At the first event of a run."""
    later_steps: Interval
    """At each later one at which it learns; it goes on from there."""
    again: Annotated[float, Range(1, 1000)]
    """It learns again at the first event by which the run has become so many times as long as at the last time."""
    halves: Annotated[float, Range(0, 100)] = 0.35
    """The models that render what it learns from are trained for this share of the steps that the run has taken. The
    default: runs older than this option."""
    batch: Annotated[int, Range(1, 4096)]
    crop: Annotated[int, Range(16, 4096)]
    """Edge of a training crop, px."""
    rate: Rate

    def __post_init__(self) -> None:
        if not (self.rate > 0 and self.halves > 0):
            raise ValueError("regenerator.restore: rate and halves must be above 0")


class Residual(nn.Module):
    """A network of three scales whose output is added to its input; it begins by changing nothing."""

    def __init__(self, channels: int, generator: torch.Generator) -> None:
        super().__init__()
        c = channels
        self.down = nn.ModuleList([block(3, c), block(c, 2 * c), block(2 * c, 4 * c)])
        self.up = nn.ModuleList([block(6 * c, 2 * c), block(3 * c, c)])
        self.last = nn.Conv2d(c, 3, 3, padding=1)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                begin(layer, generator)
        nn.init.zeros_(self.last.weight)

    def forward(self, image: Float[Tensor, "B 3 h w"]) -> Float[Tensor, "B 3 h w"]:
        """The change of each value, at most LARGEST_CHANGE."""
        height, width = image.shape[2:]
        padded = pad(image - 0.5, (0, -width % 4, 0, -height % 4), mode="replicate")
        fine = self.down[0](padded)
        middle = self.down[1](max_pool2d(fine, 2))
        coarse = self.down[2](max_pool2d(middle, 2))
        middle = self.up[0](torch.cat([interpolate(coarse, scale_factor=2), middle], 1))
        fine = self.up[1](torch.cat([interpolate(middle, scale_factor=2), fine], 1))
        return LARGEST_CHANGE * torch.tanh(self.last(fine)[:, :, :height, :width])


def block(inputs: int, outputs: int) -> nn.Sequential:
    """Two convolutions."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1), nn.SiLU(), nn.Conv2d(outputs, outputs, 3, padding=1), nn.SiLU()
    )


class SceneRestorer:
    """Learns at the first event of a run, and at some later ones goes on from there."""

    def __init__(self, options: RestorerOptions) -> None:
        self.options = options
        self.networks: list[Residual] = []
        self.useful = [False] * FOLDS
        self.prepared = -1

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """It cannot enlarge, and each half needs views to learn from."""
        refuse_enlarging("scene_restorer", scales)
        if len(views) < 2 * FOLDS:
            raise InputError(
                f"regenerator scene_restorer needs at least {2 * FOLDS} training views, there are {len(views)}: choose "
                "regenerator/restore=identity"
            )

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Trains each network on held-out renders of half of the views, and measure it on those of the other half.

        One that has become worse there goes back to what it was. One that brings renders of views it has not seen no
        closer to their photographs is not used.
        """
        if self.prepared == context.step:  # another augmenter has asked at this event
            return {}
        earlier = self.earlier(context)
        if not self.networks:
            self.networks, self.useful = self.recalled(context, earlier)
        self.prepared = context.step
        if earlier and context.step < self.options.again * event_of(earlier[-1]):
            return {}
        steps = self.options.later_steps if earlier else self.options.steps
        pairs = held_out_pairs(context, self.options.halves)
        figures: dict[str, float] = {}
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
            figures |= {f"error_of_renders_{fold}": renders, f"error_restored_{fold}": min(before, after)}
        if not any(self.useful):
            logger.warning("scene_restorer brings unseen views no closer to their photographs: it changes nothing")
        self.keep(context)
        return figures

    @torch.no_grad()
    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 h w"]]:
        """Each picture by the network that has not seen its view, as strongly as asked."""
        return [self.restored(request) for request in requests]

    def restored(self, request: Request) -> Float[Tensor, "3 h w"]:
        """One picture; the whole correction at the largest strength of any event, half of it at half of that."""
        fold = (request.number + 1) % FOLDS
        if not self.useful[fold] or request.strength == 0:
            return request.image
        network = self.networks[fold]
        image = request.image.to(next(network.parameters()).device)
        return (image + request.strength / request.strongest * network(image[None])[0]).clamp(0, 1)

    def keep(self, context: RegeneratorContext) -> None:
        """Writes both networks into the run's folder, as one file for each event at which they have learnt."""
        from safetensors.torch import save

        tensors = {
            f"{fold}.{name}": value.contiguous()
            for fold, network in enumerate(self.networks)
            for name, value in network.state_dict().items()
        } | {"useful": torch.tensor(self.useful)}
        context.folder.mkdir(parents=True, exist_ok=True)
        replace_file(context.folder / f"scene_restorer_{context.step:07d}.safetensors", save(tensors))

    def earlier(self, context: RegeneratorContext) -> list[Path]:
        """Files of the run's events before this one, oldest first."""
        files = sorted(context.folder.glob("scene_restorer_*.safetensors"))
        return [path for path in files if event_of(path) < context.step]

    def recalled(self, context: RegeneratorContext, earlier: Sequence[Path]) -> tuple[list[Residual], list[bool]]:
        """(networks, whether each is of use) as the run had them after its last event before this one, or new ones."""
        networks = [
            Residual(self.options.channels, generator).to(context.device)
            for generator in (torch.Generator().manual_seed(derived_seed(context.seed, fold)) for fold in range(FOLDS))
        ]
        found = read_network(earlier[-1]) if earlier else None
        for fold, network in enumerate(networks if found else ()):
            own = {name.partition(".")[2]: value for name, value in found.items() if name.startswith(f"{fold}.")}  # type: ignore[union-attr]
            try:
                network.load_state_dict(own)
            except RuntimeError as error:
                raise InputError(
                    f"{earlier[-1]} holds networks of another size ({str(error).splitlines()[0]}): go on with the "
                    "regenerator.restore options that the run was begun with"
                ) from error
        useful = found.get("useful") if found else None
        return networks, [False] * FOLDS if useful is None else useful.tolist()


def event_of(path: Path) -> int:
    """The event that a file of networks belongs to."""
    return int(path.stem.rpartition("_")[2])


def learn(
    network: Residual,
    pairs: Sequence[Pair],
    options: RestorerOptions,
    steps: int,
    fold: int,
    context: RegeneratorContext,
) -> None:
    """Adam on crops, L1 and a tenth of the L1 of differences of neighbours."""
    generator = torch.Generator().manual_seed(derived_seed("crops", context.seed, context.step, fold))
    device = next(network.parameters()).device
    optimiser = torch.optim.Adam(network.parameters(), lr=options.rate)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, eta_min=options.rate / 100)
    for _ in range(steps):
        context.raise_if_stopping()
        render, photo = (part.to(device) for part in batch(pairs, options, generator))
        out = render + network(render)
        loss = (out - photo).abs().mean() + 0.1 * sum(
            (out.diff(dim=axis) - photo.diff(dim=axis)).abs().mean() for axis in (2, 3)
        )
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        decay.step()


def batch(pairs: Sequence[Pair], options: RestorerOptions, generator: torch.Generator) -> Pair:
    """Crops at the same places of renders and photographs, mirrored at random."""
    edge = min(options.crop, *(min(photo.shape[1:]) for _, photo in pairs))
    parts = [random_part(pairs, (edge, edge), generator) for _ in range(options.batch)]
    renders, photos = zip(*parts, strict=True)
    return torch.stack(renders), torch.stack(photos)


@torch.no_grad()
def mean_error(network: Residual, pairs: Sequence[Pair]) -> float:
    """Mean squared error of restored renders."""
    device = next(network.parameters()).device
    given = ((render.to(device), photo) for render, photo in pairs)
    return mean_square(((image + network(image[None])[0]).clamp(0, 1).cpu(), photo) for image, photo in given)
