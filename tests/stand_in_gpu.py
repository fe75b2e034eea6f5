"""A device that is not there: tensors say that they lie on one, and are computed on the CPU.

Where the host would have to wait for a GPU is counted, as are the kernels that would be launched; tensors of two
devices in one operation are refused as CUDA refuses them. What would be compiled runs as it stands and counts as one
launch, though it may be several.

    python tests/stand_in_gpu.py OVERRIDES [/ OVERRIDES]...   # steps on the CPU, then there: losses and counts of each
"""

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import torch
from tiny import tiny_settings
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from gsx.builtin import plugins
from gsx.core.training.trainer import train_step
from gsx.experiments.runs import build
from gsx.experiments.runs.guard import Guard
from gsx.experiments.runs.load_scene import load_scene

DEVICE = torch.device("lazy", 0)
"""A kind of device that torch knows, without anything behind it in its builds; its gradients need no thread."""
READS = {"_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "bincount", "_unique2", "unique_dim",
         "unique_consecutive", "allclose"}  # fmt: skip
"""Operations whose result, or its size, the host waits for."""
FREE = {"detach", "view", "_unsafe_view", "expand", "permute", "transpose", "t", "slice", "select", "unsqueeze",
        "squeeze", "split", "split_with_sizes", "unbind", "as_strided", "alias", "reshape", "_reshape_alias", "unfold",
        "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "lift_fresh", "narrow", "diagonal",
        "_local_scalar_dense"}  # fmt: skip
"""Operations that launch nothing."""
STEPS = 4
"""Steps of a case."""


@dataclass
class Tally:
    """What a device would have done, by operation and the line of gsx that asked for it."""

    waits: Counter[str] = field(default_factory=Counter)
    launches: Counter[str] = field(default_factory=Counter)
    inside: str = ""
    """Compiled function under way."""

    def note(self, counts: Counter[str], name: str, so: bool) -> None:
        """Count an operation, if it is so."""
        if so:
            counts[f"{name} {asked_by()}"] += 1

    def begin(self) -> None:
        """Count from here on."""
        self.waits.clear()
        self.launches.clear()


class OnDevice(Tensor):
    """A tensor that says it lies on the device."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor):
        made = Tensor._make_wrapper_subclass(
            cls, held.size(), held.stride(), held.storage_offset(), dtype=held.dtype, device=DEVICE
        )
        made.held = held
        return made

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        raise AssertionError(f"{func} of a tensor on the device, outside of it")

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def new_tensor(self, values: Any) -> Tensor:
        return torch.tensor(values, dtype=self.dtype).to(self.device)


def mapped(change: Callable[[Any], Any], value: Any) -> Any:
    """What operations take and give, changed: tensors and what else there is, and lists of these."""
    return type(value)([mapped(change, one) for one in value]) if isinstance(value, list | tuple) else change(value)


def tensors_in(values: Iterable[Any]) -> Iterator[Tensor]:
    """All tensors of what an operation takes."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from tensors_in(value)


def there(value: Any) -> Any:
    """The tensor, said to be on the device."""
    return OnDevice(value) if isinstance(value, Tensor) and not isinstance(value, OnDevice) else value


def here(value: Any) -> Any:
    """What is held of a tensor on the device."""
    return value.held if isinstance(value, OnDevice) else value


def asked_by() -> str:
    """The line of gsx that is being carried out."""
    frame: Any = sys._getframe(1)
    while frame is not None and "/src/gsx/" not in frame.f_code.co_filename:
        frame = frame.f_back
    return "" if frame is None else f"{frame.f_code.co_filename.split('/src/gsx/')[1]}:{frame.f_lineno}"


class Watched(TorchDispatchMode):
    """Carries operations out on the CPU, and counts those of the device."""

    def __init__(self, tally: Tally) -> None:
        super().__init__()
        self.tally = tally

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs, name = dict(kwargs or {}), func.overloadpacket.__name__
        tensors = list(tensors_in((*args, *kwargs.values())))
        ours = [value for value in tensors if isinstance(value, OnDevice)]
        asked = kwargs.get("device")
        onto = torch.device(asked).type == DEVICE.type if asked is not None else bool(ours)
        if not ours and not onto:
            return func(*args, **kwargs)
        if asked is not None:
            kwargs["device"] = "cpu"
        moved = name in ("_to_copy", "copy_") and (not onto or len(ours) < len(tensors))
        if moved:
            waiting = not (kwargs.get("non_blocking") or (name == "copy_" and len(args) > 2 and args[2]))
            self.tally.note(self.tally.waits, name, waiting)
        else:
            refuse_two_devices(name, tensors)
            self.count(name, args, kwargs)
        result = func(*mapped(here, args), **{key: mapped(here, value) for key, value in kwargs.items()})
        if func._schema.name.endswith("_") and args and isinstance(args[0], OnDevice):
            return args[0]
        return mapped(there, result) if onto else result

    def count(self, name: str, args: Any, kwargs: dict[str, Any]) -> None:
        """One operation of tensors that lie there."""
        indices = list(tensors_in(args[1:2])) if "index" in name else []
        masked = any(value.dtype == torch.bool for value in indices)  # torch looks for the places that are marked
        sized = name == "repeat_interleave" and kwargs.get("output_size") is None
        self.tally.note(self.tally.waits, name, name in READS or masked or sized)
        self.tally.note(self.tally.launches, name, name not in FREE and not self.tally.inside)


def refuse_two_devices(name: str, tensors: list[Tensor]) -> None:
    """Raise RuntimeError as CUDA does: only single numbers may lie elsewhere."""
    strangers = [value for value in tensors if not isinstance(value, OnDevice) and value.dim() > 0]
    if strangers and len(strangers) < len(tensors):
        raise RuntimeError(f"{name} at {asked_by()}: tensors on two devices, {[tuple(t.shape) for t in tensors]}")


@contextmanager
def one_launch(tally: Tally, name: str) -> Iterator[None]:
    """Whatever is launched meanwhile counts as one."""
    tally.launches[f"compiled {name}"] += not tally.inside
    before, tally.inside = tally.inside, name
    try:
        yield
    finally:
        tally.inside = before


class Compiled(torch.autograd.Function):
    """A function and its backward, one launch each."""

    @staticmethod
    def forward(ctx, function, tally, *arguments):
        ctx.tally, ctx.name = tally, function.__name__
        ctx.given = [
            value.detach().requires_grad_(value.requires_grad) if isinstance(value, Tensor) else value
            for value in arguments
        ]
        with one_launch(tally, ctx.name), torch.enable_grad():
            ctx.made = function(*ctx.given)
        return mapped(lambda value: value.detach() if isinstance(value, Tensor) else value, ctx.made)

    @staticmethod
    def backward(ctx, *by_made):
        made = ctx.made if isinstance(ctx.made, tuple) else (ctx.made,)
        pairs = [(value, by) for value, by in zip(made, by_made, strict=True) if by is not None and value.requires_grad]
        learnt = [isinstance(value, Tensor) and value.requires_grad for value in ctx.given]
        inputs = [value for value, learns in zip(ctx.given, learnt, strict=True) if learns]
        with one_launch(ctx.tally, f"{ctx.name} backward"):
            found = iter(
                torch.autograd.grad([of for of, _ in pairs], inputs, [by for _, by in pairs], allow_unused=True)
            )
        return None, None, *(next(found) if learns else None for learns in learnt)


def uncompiled(tally: Tally) -> Callable[..., Any]:
    """In place of torch.compile."""

    def compile_(function: Callable[..., Any], **_: Any) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            if torch.is_grad_enabled() and any(isinstance(a, Tensor) and a.requires_grad for a in arguments):
                return Compiled.apply(function, tally, *arguments)
            with one_launch(tally, function.__name__):
                return function(*arguments)

        return call

    return compile_


def filled_on_the_host(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """In place of torch.tensor, which fills what it makes on the host and copies that."""

    def make(*args: Any, device: Any = None, **options: Any) -> Tensor:
        made = function(*args, **options)
        return made if device is None else made.to(device)

    return make


@contextmanager
def stand_in() -> Iterator[Tally]:
    """While it holds, `DEVICE` can be computed on, and is watched. Nothing may have been compiled before."""
    tally = Tally()
    with (
        patch.object(torch, "compile", uncompiled(tally)),
        patch.object(torch, "tensor", filled_on_the_host(torch.tensor)),
        patch.object(torch._dynamo, "maybe_mark_dynamic", lambda *_: None),
        patch("torch.optim.optimizer._get_fused_kernels_supported_devices", lambda: [DEVICE.type]),
        Watched(tally),
    ):
        yield tally


def losses(words: list[str], device: torch.device, begin: Callable[[], None] = lambda: None) -> list[Tensor]:
    """Losses of the first steps of a tiny run; `begin` is called before each."""
    loaded, values = plugins(), list[Tensor]()
    with TemporaryDirectory() as folder, patch.object(build, "choose_device", lambda _: device):
        settings = tiny_settings(Path(folder), "iterations=100", *words)
        run = build.build(settings, load_scene(settings), Path(folder), training=True)
        with loaded.listening([Guard()]):
            for _ in range(STEPS):
                begin()
                values.append(train_step(run, loaded).loss)
    return values


def main(words: list[str]) -> None:
    """Prints losses on the CPU and on the device and the counts of the last step of each case, as JSON."""
    cases = [part.split("\n") for part in "\n".join(words).split("\n/\n")]
    own = [losses([*case, "rasterizer=eager"], torch.device("cpu")) for case in cases]
    found = []
    with stand_in() as tally, patch.object(build, "decide", lambda raster, *_: raster):
        for case, on_cpu in zip(cases, own, strict=True):
            on_device = losses([*case, "rasterizer=compiled"], DEVICE, tally.begin)
            counts = {"waits": tally.waits.copy(), "launches": tally.launches.copy()}
            both = {"cpu": on_cpu, "device": on_device}
            found.append({name: [float(loss) for loss in values] for name, values in both.items()} | counts)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
