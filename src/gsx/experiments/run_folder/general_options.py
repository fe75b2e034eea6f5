"""Options of a run as a whole."""

from dataclasses import dataclass

from gsx.core.options import label, without_effect

LARGEST_SEED = 2**63
"""Seeds are below: generators take 64 bits with a sign."""


@dataclass(frozen=True, kw_only=True)
class GeneralOptions:
    """Top-level values; conf/config.yaml gives them."""

    iterations: int
    seed: int
    device: str = without_effect()
    output: str = without_effect()
    folder: str = without_effect()
    length: int = label(default=0)
    """Iterations of the whole run, of which a budget takes a share: the variant's, the scene's or the backbone's."""
    variant: str = label(default="")
    """Name of the published method that is composed; empty for others."""
    data_root: str = without_effect(default="")
    """Where datasets lie."""
    reuse: bool = without_effect(default=False)
    """The run's folder is named by its composition; what is finished there is not trained again (`run_key`)."""
    init: str = without_effect(default="scratch")
    """scratch, or warm_start: branch from an earlier run that differs in its augmenters alone (`warm_start`)."""
    warm_start_at: list[int] = without_effect(default_factory=list)
    """Steps at which states are kept for other runs; none given: where the paper's variants begin."""
    warm_start_gb: float = without_effect(default=10.0)
    """Disk for the states that runs branch from, 10^9 bytes; those used longest ago make room."""

    def __post_init__(self) -> None:
        if not 0 <= self.seed < LARGEST_SEED:
            raise ValueError(f"seed is {self.seed}; give a number from 0 to below 2^63")
        for step in self.warm_start_at:
            if step < 1:
                raise ValueError(f"warm_start_at has {step}; give steps from 1")
        if self.init not in ("scratch", "warm_start"):
            raise ValueError(f"init is '{self.init}'; choose scratch or warm_start")
        if self.reuse and self.folder:
            raise ValueError(f"reuse=true names the folder itself; leave out folder={self.folder}")
        if not self.warm_start_gb >= 0:
            raise ValueError(f"warm_start_gb is {self.warm_start_gb}; give 10^9 bytes from 0")
