"""Writes mcmc.safetensors: relocation, copies and noise by gsplat 1.5.3.

    pip install --no-deps gsplat==1.5.3 && python tests/golden/make_mcmc.py

No test runs it. All code is gsplat's: `relocate`, `sample_add` and `inject_noise_to_position` of gsplat/strategy/ops.py
edit parameters and Adam states. What needs a GPU there is replaced: the kernel of RelocationCUDA.cu, plain C++, is
compiled for the CPU, and covariances come from gsplat's torch function. Drawn rows and noise are fixed and stored.
"""

import ctypes
import subprocess
import tempfile
from importlib.metadata import version
from pathlib import Path
from unittest.mock import patch

import gsplat
import torch
from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci
from gsplat.strategy import ops
from gsplat.strategy.mcmc import MCMCStrategy
from safetensors.torch import save_file
from torch import Tensor

FILE = Path(__file__).parent / "mcmc.safetensors"
COUNT, SCALER = 12, 1.6e-4 * 5e5
MOVED = torch.tensor([0, 0, 3, 5])
"""Donors of four dead rows: one of them serves two."""
COPIED = torch.tensor([1, 1, 1, 7, 9])
OPACITIES = [0.9, 0.5, 0.004, 0.99, 0.0049, 0.05, 0.001, 0.999, 0.3, 0.02, 0.0, 0.7]
PRELUDE = """
#include <cmath>
using std::pow; using std::sqrt;
struct Index { int x; } static threadIdx{0}, blockDim{1}, blockIdx{0};
#define __global__
"""
ENTRY = """
extern "C" void run(int N, double *o, double *s, int *r, double *b, int most, double *new_o, double *new_s) {
    for (int i = 0; i < N; ++i) { blockIdx.x = i; relocation_kernel<double>(N, o, s, r, b, most, new_o, new_s); }
}
"""


def compiled_kernel() -> ctypes.CDLL:
    """gsplat's relocation kernel as a function of the CPU."""
    source = (Path(gsplat.__file__).parent / "cuda/csrc/RelocationCUDA.cu").read_text()
    kernel = source[source.index("template <typename scalar_t>") : source.index("void launch_relocation_kernel")]
    folder = Path(tempfile.mkdtemp())
    (folder / "kernel.cpp").write_text(PRELUDE + kernel + ENTRY)
    subprocess.run(["g++", "-O1", "-shared", "-fPIC", "kernel.cpp", "-o", "kernel.so"], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "kernel.so"))


def relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """compute_relocation of gsplat, in double."""
    ratios = ratios.clamp(1, len(binoms)).int().contiguous()
    inputs = [opacities.contiguous(), scales.contiguous(), ratios, binoms.double().contiguous()]
    outputs = [torch.empty_like(opacities), torch.empty_like(scales)]
    pointers = [ctypes.c_void_p(value.data_ptr()) for value in (*inputs, *outputs)]
    compiled_kernel().run(len(opacities), *pointers[:4], len(binoms), *pointers[4:])
    return outputs[0], outputs[1]


def started() -> tuple[dict[str, Tensor], dict[str, torch.optim.Adam]]:
    """Gaussians and optimisers that have taken two steps."""
    g = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}
    values = {name: torch.randn(COUNT, *shape, generator=g).double() for name, shape in shapes.items()}
    values["scales"] = 0.5 * values["scales"] - 4
    values["opacities"] = torch.tensor(OPACITIES).logit().clamp_min(-20).double()
    params = {name: torch.nn.Parameter(value) for name, value in values.items()}
    optimisers = {name: torch.optim.Adam([value], lr=0.0) for name, value in params.items()}
    for _ in range(2):
        for name, value in params.items():
            value.grad = torch.randn(value.shape, generator=g).double()
            optimisers[name].step()
    return params, optimisers


def stored(name: str, params: dict[str, Tensor], optimisers: dict[str, torch.optim.Adam]) -> dict[str, Tensor]:
    """Parameters and moments."""
    states = {key: optimisers[key].state[value] for key, value in params.items()}
    moments = {f"{name}.{key}.{k}": state[k] for key, state in states.items() for k in ("exp_avg", "exp_avg_sq")}
    both = {f"{name}.{key}": value.detach() for key, value in params.items()} | moments
    return {key: value.clone() for key, value in both.items()}


@torch.no_grad()
def main() -> None:
    binoms = MCMCStrategy().initialize_state()["binoms"]
    params, optimisers = started()
    tensors = stored("start", params, optimisers) | {"moved": MOVED, "copied": COPIED}
    dead = params["opacities"].sigmoid() <= 0.005
    living = (~dead).nonzero()[:, 0]
    places = torch.searchsorted(living, MOVED)
    covariances = lambda quats, scales, **kwargs: _quat_scale_to_covar_preci(quats, scales, **kwargs)  # noqa: E731
    with patch.object(ops, "compute_relocation", relocation):
        with patch.object(ops, "_multinomial_sample", lambda weights, n, replacement: places):
            ops.relocate(params, optimisers, {}, dead, binoms)
        tensors |= stored("relocated", params, optimisers)
        with patch.object(ops, "_multinomial_sample", lambda weights, n, replacement: COPIED):
            ops.sample_add(params, optimisers, {}, len(COPIED), binoms)
        tensors |= stored("added", params, optimisers)
    noise = torch.randn(len(params["means"]), 3, generator=torch.Generator().manual_seed(1))
    with (
        patch.object(ops, "quat_scale_to_covar_preci", covariances),
        patch.object(torch, "randn_like", lambda like: noise.to(like)),
    ):
        ops.inject_noise_to_position(params, optimisers, {}, SCALER)
    tensors |= stored("noisy", params, optimisers) | {"noise": noise}
    made_by = f"gsplat {version('gsplat')}, torch {torch.__version__}"
    save_file({name: value.contiguous() for name, value in tensors.items()}, FILE, metadata={"made_by": made_by})
    print(f"{FILE}: {FILE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
