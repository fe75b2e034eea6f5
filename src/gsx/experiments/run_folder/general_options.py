"""Options of a run as a whole."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from gsx.core.options import label, without_effect
from gsx.core.ranges import MOST_STEPS, Gigabytes, Range, Seed, Share, Steps
from gsx.formats.axis_names import AUTO, CHOICES, EXAMPLES
from gsx.formats.suffixes import READABLE, suffix_of

BEGINNINGS = ("scratch", "warm_start")
"""Values of `init` that are no file; both train the same."""


def splat_file(init: Any) -> Path | None:
    """Returns the splat file that a value of `init` names; None: it names none."""
    return None if init is None or init in BEGINNINGS else Path(str(init))


@dataclass(frozen=True, kw_only=True)
class GeneralOptions:
    """Top-level values; conf/config.yaml gives them."""

    iterations: Steps
    """0: what a splat file holds is evaluated as it is (`init`)."""
    seed: Seed
    device: str = without_effect()
    output: str = without_effect()
    folder: str = without_effect()
    length: Steps = label(default=0)
    """Iterations before a budget takes its share."""
    variant: str = label(default="")
    """Name of the published method that is composed; empty for others."""
    data_root: str = without_effect(default="")
    """Where datasets lie."""
    reuse: bool = without_effect(default=False)
    """Names the run's folder by its composition and trains nothing again that is finished there (`run_key`)."""
    init: str = without_effect(default="scratch")
    """scratch; warm_start: branch from an earlier run; or a splat file to go on from, which counts in `run_key`."""
    axes: str = without_effect(default=AUTO)
    """Axes of the splat file of `init`: auto, or three letters, which count in `run_key`."""
    warm_start_at: Annotated[list[int], Range(1, MOST_STEPS)] = without_effect(default_factory=list)
    """Steps at which states are kept for other runs; empty: where the paper's variants begin."""
    disk_cache_gb: Gigabytes = without_effect(default=20.0)
    """Size of the cache that runs share: states, reconstructions, pictures, networks."""

    viewer: bool = without_effect(default=False)
    """Shows the model in a browser during training."""
    viewer_host: str = without_effect(default="127.0.0.1")
    """Address at which the viewer listens."""
    viewer_port: Annotated[int, Range(0, 65535)] = without_effect(default=8080)
    """0: any free port."""
    viewer_share: Share = without_effect(default=0.25)
    """Share of the time for the viewer's pictures."""

    def __post_init__(self) -> None:
        file = splat_file(self.init)
        if file is not None and not suffix_of(file):
            raise ValueError(f"init is '{self.init}'; choose scratch, warm_start, or a splat file ({READABLE})")
        if self.axes not in CHOICES:
            raise ValueError(f"axes is '{self.axes}'; choose {EXAMPLES}")
        if self.iterations < 1 and file is None:
            raise ValueError("iterations is 0; give 1 or more steps, or init=FILE, a splat file to evaluate as it is")
        if self.reuse and self.folder:
            raise ValueError(f"reuse=true names the folder itself; leave out folder={self.folder}")
