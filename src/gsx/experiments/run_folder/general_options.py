"""Options of a run as a whole."""

from dataclasses import dataclass
from typing import Annotated

from gsx.core.options import label, without_effect
from gsx.core.ranges import MOST_STEPS, Gigabytes, Interval, Range, Seed, Steps


@dataclass(frozen=True, kw_only=True)
class GeneralOptions:
    """Top-level values; conf/config.yaml gives them."""

    iterations: Interval
    seed: Seed
    device: str = without_effect()
    output: str = without_effect()
    folder: str = without_effect()
    length: Steps = label(default=0)
    """Iterations of the whole run, of which a budget takes a share: the variant's, the scene's or the backbone's."""
    variant: str = label(default="")
    """Name of the published method that is composed; empty for others."""
    data_root: str = without_effect(default="")
    """Where datasets lie."""
    reuse: bool = without_effect(default=False)
    """The run's folder is named by its composition; what is finished there is not trained again (`run_key`)."""
    init: str = without_effect(default="scratch")
    """scratch, or warm_start: branch from an earlier run that differs in its augmenters alone (`warm_start`)."""
    warm_start_at: Annotated[list[int], Range(1, MOST_STEPS)] = without_effect(default_factory=list)
    """Steps at which states are kept for other runs; none given: where the paper's variants begin."""
    disk_cache_gb: Gigabytes = without_effect(default=20.0)
    """For what runs share: states, reconstructions, undistorted and redrawn pictures, networks."""

    def __post_init__(self) -> None:
        if self.init not in ("scratch", "warm_start"):
            raise ValueError(f"init is '{self.init}'; choose scratch or warm_start")
        if self.reuse and self.folder:
            raise ValueError(f"reuse=true names the folder itself; leave out folder={self.folder}")
