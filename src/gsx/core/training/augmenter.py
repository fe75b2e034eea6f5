"""What an augmenter is built from, and what it may offer beside its terms; the protocol itself is `run.Augmenter`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from gsx.core.data.scene import Scene
from gsx.core.shapes import Float
from gsx.core.training.regenerator import Regenerator
from gsx.core.training.run import Augmenter, Run

__all__ = ["Accounting", "Augmenter", "AugmenterContext", "Foretold", "Replacing", "accounts_of", "recall_accounts"]


@dataclass(frozen=True, eq=False, kw_only=True)
class AugmenterContext:
    """What an augmenter is built from."""

    name: str
    scene: Scene
    iterations: int
    seed: int
    regenerator: Callable[[str], Regenerator]
    """The regenerator of a role, `upscale` or `restore`."""
    checks: Mapping[str, Any] = field(default_factory=dict)
    """Limits for redrawn pictures by role (`augmenters.checks`), for augmenters without checks among their options."""
    held_out: Callable[[Run, float, int], list[Float[Tensor, "3 h w"]]] = lambda run, share, seed: []
    """(run, share of its steps, seed) -> training views rendered by models of the other views
    (`RegeneratorContext.held_out`)."""


@runtime_checkable
class Replacing(Protocol):
    """An augmenter whose terms take the place of a part of the photographs' own loss."""

    def share(self) -> float:
        """The largest part, from 0; those of all augmenters of a run add up to less than 1."""
        ...


@runtime_checkable
class Accounting(Protocol):
    """An augmenter that counts the pictures which it requests and loses.

    An account has `event`, the last step of the model that was redrawn, and counts by scale: `asked`, `dropped`, and
    `warned` by check.
    """

    def account(self, step: int) -> dict[str, Any]:
        """Reports the pictures requested at a step; empty if there were none."""
        ...

    def recall(self, accounts: Sequence[Mapping[str, Any]]) -> None:
        """Counts the pictures that the run requested before it was interrupted."""
        ...


@runtime_checkable
class Foretold(Protocol):
    """Options of an augmenter that know, before there is a scene, where it begins; plans over many runs need it."""

    def begins(self, iterations: int) -> int:
        """Returns what `Augmenter.begins` will in a run of that length."""
        ...


def accounts_of(run: Run, step: int) -> dict[str, dict[str, Any]]:
    """Collects the accounts of a step by augmenter, of those that requested pictures."""
    accounting = {name: one for name, one in run.augmenters.items() if isinstance(one, Accounting)}
    accounts = {name: augmenter.account(step) for name, augmenter in accounting.items()}
    return {name: account for name, account in accounts.items() if account}


def recall_accounts(augmenters: Mapping[str, Augmenter], lines: Sequence[Mapping[str, Any]]) -> None:
    """Gives the accounts in lines of metrics.jsonl back to the augmenters of a resumed run."""
    for name, augmenter in augmenters.items():
        if isinstance(augmenter, Accounting):
            accounts = (line.get("pseudo", {}).get(name) for line in lines)
            augmenter.recall([account for account in accounts if account])
