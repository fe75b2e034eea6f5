"""The backbone `spheres`: a mean, a radius, an opacity and a colour each, as many as there are points."""

from dataclasses import dataclass
from typing import Annotated

import torch
from torch.nn import Parameter
from torch.nn.functional import logsigmoid

from gsx.backbones.neighbours import mean_square_distance
from gsx.core.gaussians.sh import constant_from_colour
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.ranges import Interval, Range, Rate
from gsx.core.training.backbone import BackboneContext, DrawnSplats
from gsx.core.training.parameter_table import ParameterTable, take_adam_step


@dataclass(frozen=True, kw_only=True)
class SpheresOptions:
    name: str
    published_iterations: Interval
    opacity: Annotated[float, Range(0.01, 0.99)]
    means: Rate
    log_radii: Rate
    opacity_logits: Rate
    colours: Rate


class Spheres:
    absolute_gradient = False

    def __init__(self, options: SpheresOptions, context: BackboneContext) -> None:
        points, self.raster = context.points(), context.raster
        values = {
            "means": points.positions.clone(),
            "log_radii": mean_square_distance(points.positions).clamp_min(1e-7).log() / 2,
            "opacity_logits": torch.full((len(points),), options.opacity).logit(),
            "colours": points.colours.float() / 255,
        }
        self.table = ParameterTable({name: Parameter(value.to(context.device)) for name, value in values.items()})
        for name in values:
            unit = context.scene.extent if name == "means" else 1.0
            self.table.set_rate(name, unit * getattr(options, name))

    def draw(self, camera, step):
        means, radii = self.table["means"], self.table["log_radii"].exp()
        quats = torch.tensor([1.0, 0, 0, 0], device=means.device).expand(len(means), 4)
        opacities, colours = logsigmoid(self.table["opacity_logits"]), self.table["colours"].clamp_min(0)
        return DrawnSplats(
            splats=Splats(
                means=means, scales=radii[:, None].expand(-1, 3), quats=quats, log_opacities=opacities, colours=colours
            )
        )

    def regulariser(self, drawn):
        return None

    def observe(self, drawn, rendering, step, weight=1.0):
        return {}  # there is no density control

    def accumulate(self, seen): ...

    def densify_and_prune(self, step):
        return {}

    def update(self, step):
        take_adam_step(self.table)

    def explicit(self, camera, step):
        splats = self.draw(camera, step).splats
        return Gaussians(
            means=splats.means.detach(),
            log_scales=splats.scales.detach().log(),
            quats=splats.quats,
            opacity_logits=self.table["opacity_logits"].detach(),
            sh_dc=constant_from_colour(splats.colours.detach()),
            sh_rest=splats.colours.new_zeros(len(splats.colours), 0, 3),
        )
