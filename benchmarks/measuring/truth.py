"""Pictures and gradients of a device against float64 on the CPU, and whether they are the same bits twice."""

import torch
from torch import Tensor

from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from measuring.adapter import settings_of
from measuring.bench import Bench, Row, section
from measuring.cases import Case, camera_of, gradient_of, splats_of
from measuring.results import Section

CPU = torch.device("cpu")


def truth_section(bench: Bench) -> Section:
    """A row for each path."""
    rows = []
    for size in (1.0, 3.0):
        case = Case(splats=bench.pick(3000, 60), width=bench.pick(200, 43), height=bench.pick(136, 30), size=size)
        truth = drawn(case, CPU, torch.float64, settings_of("eager"))
        for path in bench.paths:
            once, twice = (drawn(case, bench.device, torch.float32, settings_of(path)) for _ in range(2))
            rows.append(row_of(case, path, once, truth) | {"same": "yes" if same(once, twice) else "no"})
    columns = [["path", "path"], ["splats", "splats"], ["raster", "raster"], ["size", "size x"]]
    columns += [["image", "image"], ["gradient", "worst gradient"], ["same", "same bits twice"]]
    return section(
        bench, "Truth", columns, rows, "Norm of the difference from float64 on the CPU over the norm of that."
    )


def drawn(case: Case, device: torch.device, dtype: torch.dtype, settings: RasterSettings) -> dict[str, Tensor]:
    """The picture and the gradient of every field, on the CPU."""
    fields = {name: value.detach().to(device, dtype) for name, value in vars(splats_of(case, CPU)).items()}
    splats = Splats(**{name: value.requires_grad_() for name, value in fields.items()})
    image = rasterize(splats, camera_of(case), settings).image
    image.backward(gradient_of(case, CPU).to(image))
    slopes = {name: value.grad for name, value in vars(splats).items() if value.grad is not None}
    return {name: value.detach().cpu() for name, value in ({"image": image} | slopes).items()}


def same(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    """Whether all bits are."""
    return all(torch.equal(value, other[name]) for name, value in one.items())


def row_of(case: Case, path: str, found: dict[str, Tensor], truth: dict[str, Tensor]) -> Row:
    """Sizes and relative errors of a case."""
    errors = {name: float((value - truth[name]).norm() / truth[name].norm()) for name, value in found.items()}
    image = errors.pop("image")
    numbers = {"path": path, "splats": case.splats, "raster": case.raster, "size": case.size}
    return numbers | {"image": image, "gradient": max(errors.values())}
