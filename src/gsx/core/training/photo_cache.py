"""Training photos on the run's device, with their SSIM moments on a CPU."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gsx.core.backend import Backend
from gsx.core.data.scene import View
from gsx.core.device import upload
from gsx.core.quality.losses import moments_of
from gsx.core.shapes import Float, UInt8

GPU_SHARE = 0.25
"""Largest share of a GPU's free memory for photos."""
MOMENT_BYTES = 1 << 26
"""Most bytes for SSIM moments of all photos; computing them takes 1 % of a step, up to 2 % with few primitives."""


def room_for_photos(device: torch.device) -> int:
    """Returns the bytes that photos may take on a device; 0 on a CPU, where scenes keep them."""
    return int(GPU_SHARE * torch.cuda.mem_get_info(device)[0]) if device.type == "cuda" else 0


@dataclass(eq=False)
class PhotoCache:
    """Photos of a run's training views on its device."""

    device: torch.device
    room: int = 0
    """Bytes left for more photos."""
    kept: dict[View, UInt8[Tensor, "3 H W"]] = field(default_factory=dict)
    moments: dict[View, tuple[Tensor, Tensor]] = field(default_factory=dict)
    """SSIM moments of photos (`losses.moments_of`)."""
    views: Sequence[View] = ()
    """Current training views."""

    def set_views(self, views: Sequence[View]) -> None:
        """Sets the current training views and drops the photos of all others."""
        if views is self.views:
            return
        self.views, current = views, set(views)
        for view in [view for view in self.kept if view not in current]:
            self.room += self.kept.pop(view).nbytes
        self.moments = {view: moments for view, moments in self.moments.items() if view in current}

    def of(self, view: View) -> Float[Tensor, "3 H W"]:
        """Returns `view.image()` on the device."""
        picture = self.kept.get(view)
        if picture is None:
            picture = upload(view.picture(), self.device)
            if picture.nbytes <= self.room:
                self.kept[view], self.room = picture, self.room - picture.nbytes
        return picture.float() / 255.0

    def moments_of(
        self, view: View, target: Float[Tensor, "3 H W"], backend: Backend
    ) -> tuple[Float[Tensor, "3 H W"], Float[Tensor, "3 H W"]] | None:
        """Returns the SSIM moments of a photo; None: the loss computes them.

        On a GPU and where MOMENT_BYTES have no room for those of all views: a few of many would save no time.
        """
        found = self.moments.get(view)
        if found is not None or self.device.type != "cpu":
            return found
        if 2 * target.nbytes * len(self.views) > MOMENT_BYTES:
            return None
        with torch.no_grad():  # by the same compiled code as in the loss
            found = self.moments[view] = moments_of(target, backend=backend)
        return found
