"""Photographs where a run computes: bytes on the device, as long as there is room, made into numbers there; on a CPU
also what the loss takes of them alone."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.device import uploaded
from gsx.core.quality.losses import moments_of
from gsx.core.shapes import Float, UInt8

SHARE = 0.25
"""Of a GPU's free memory, at most, that photographs take."""
MOMENT_BYTES = 1 << 29
"""That SSIM's moments of photographs take, at most."""


def room_for_photographs(device: torch.device) -> int:
    """Bytes that photographs may take on a device; on a CPU none, where scenes keep them."""
    return int(SHARE * torch.cuda.mem_get_info(device)[0]) if device.type == "cuda" else 0


@dataclass(eq=False)
class Photographs:
    """Of a run's training views."""

    device: torch.device
    room: int
    """Bytes that are left for more of them."""
    kept: dict[View, UInt8[Tensor, "3 H W"]] = field(default_factory=dict)
    moments: dict[View, tuple[Tensor, Tensor]] = field(default_factory=dict)
    """What SSIM takes of photographs alone (`moments_of`)."""
    views: Sequence[View] = ()
    """Those that are trained on now."""

    def see(self, views: Sequence[View]) -> None:
        """From now on these are trained on; all others go."""
        if views is self.views:
            return
        self.views, wanted = views, set(views)
        for view in [view for view in self.kept if view not in wanted]:
            self.room += self.kept.pop(view).nbytes
        self.moments = {view: found for view, found in self.moments.items() if view in wanted}

    def of(self, view: View) -> Float[Tensor, "3 H W"]:
        """What `view.image()` is, on the device."""
        return numbers_of(self.bytes_of(view))

    def moments_of(
        self, view: View, target: Float[Tensor, "3 H W"], compiled: bool
    ) -> tuple[Float[Tensor, "3 H W"], Float[Tensor, "3 H W"]] | None:
        """What SSIM takes of a photograph alone, `target`; None where it is not kept: compiled code of a GPU finds all
        at once, and what there is no room for is as soon found anew."""
        found = self.moments.get(view)
        if found is not None or self.device.type != "cpu":
            return found
        taken = sum(2 * one.nbytes for one, _ in self.moments.values())
        if taken + 2 * target.nbytes > MOMENT_BYTES:
            return None
        with torch.no_grad():  # as the loss finds them: by the same compiled code
            found = self.moments[view] = moments_of(target, compiled=compiled)
        return found

    def bytes_of(self, view: View) -> UInt8[Tensor, "3 H W"]:
        """The photograph, on the device."""
        picture = self.kept.get(view)
        if picture is None:
            picture = uploaded(view.picture(), self.device)
            if picture.nbytes <= self.room:
                self.kept[view], self.room = picture, self.room - picture.nbytes
        return picture


def numbers_of(photograph: UInt8[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """A photograph in [0, 1]."""
    return photograph.float() / 255.0
