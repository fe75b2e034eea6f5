"""Options of a run as a whole."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from gsx.core.options import label, without_effect
from gsx.core.ranges import MOST_STEPS, Gigabytes, Range, Seed, Share, Steps
from gsx.formats.axis_names import AUTO, CHOICES, EXAMPLES
from gsx.formats.suffixes import READABLE, suffix_of

BEGINNINGS = ("scratch", "warm_start")
"""Values of `init` that are not a file; both train the same."""


def splat_file(init: Any) -> Path | None:
    """Return the splat file that a value of `init` names, if any."""
    return None if init is None or init in BEGINNINGS else Path(str(init))


@dataclass(frozen=True, kw_only=True)
class GeneralOptions:
    """Top-level values; conf/config.yaml sets and explains them."""

    iterations: Steps
    """0: evaluate the splat file of `init` as it is."""
    seed: Seed
    minutes: Annotated[float, Range(0, 10**6)] = without_effect(default=0.0)
    """Wall time from the command to the report, by which the run is planned; 0: by steps."""
    seconds: Annotated[float, Range(0, 10**8)] = without_effect(default=0.0)
    """The same in seconds."""
    device: str = without_effect()
    output: str = without_effect()
    folder: str = without_effect()
    length: Steps = label(default=0)
    """Iterations before the budget's share."""
    variant: str = label(default="")
    """Name of a published method; empty for others."""
    data_root: str = without_effect(default="")
    reuse: bool = without_effect(default=False)
    init: str = without_effect(default="scratch")
    """scratch, warm_start, or a splat file, which counts in `run_key`."""
    axes: str = without_effect(default=AUTO)
    """Axes of the splat file of `init`: auto, or three letters, which count in `run_key`."""
    warm_start_at: Annotated[list[int], Range(1, MOST_STEPS)] = without_effect(default_factory=list)
    disk_cache_gb: Gigabytes = without_effect(default=20.0)
    viewer: bool = without_effect(default=False)
    viewer_host: str = without_effect(default="127.0.0.1")
    viewer_port: Annotated[int, Range(0, 65535)] = without_effect(default=8080)
    viewer_share: Share = without_effect(default=0.25)

    def __post_init__(self) -> None:
        if self.minutes and self.seconds:
            raise ValueError(f"minutes is {self.minutes:g} and seconds {self.seconds:g}: give one of them")
        file = splat_file(self.init)
        if file is not None and not suffix_of(file):
            raise ValueError(f"init is '{self.init}'; choose scratch, warm_start, or a splat file ({READABLE})")
        if self.axes not in CHOICES:
            raise ValueError(f"axes is '{self.axes}'; choose {EXAMPLES}")
        if self.iterations < 1 and file is None:
            raise ValueError("iterations is 0; give 1 or more steps, or init=FILE, a splat file to evaluate as it is")
        if self.reuse and self.folder:
            raise ValueError(f"reuse=true names the folder itself; leave out folder={self.folder}")
