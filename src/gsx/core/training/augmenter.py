"""Augmenters: they make pseudo views from training views and add terms to the loss.

A plugin registers one by `registry.add("augmenter", NAME, factory, options)`; `factory(options, context)` returns an
`Augmenter`. It may implement the other protocols of this module as well.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from torch import Tensor

from gsx.core.data.scene import Scene
from gsx.core.shapes import Float
from gsx.core.training.pseudo_views import Term
from gsx.core.training.regenerator import Regenerator

if TYPE_CHECKING:
    from gsx.core.training.run import Run


@dataclass(frozen=True, eq=False, kw_only=True)
class AugmenterContext:
    """Scene, schedule and regenerators that an augmenter is built from."""

    name: str
    scene: Scene
    iterations: int
    """Steps of the whole run."""
    seed: int
    regenerator: Callable[[str], Regenerator]
    """Returns the regenerator of a role, `upscale` or `restore`."""
    checks: Mapping[str, Any] = field(default_factory=dict)
    """Limits for regenerated pictures by role (`augmenters.checks`), for augmenters without checks in their options."""
    held_out: Callable[["Run", float, int], list[Float[Tensor, "3 h w"]]] = lambda run, share, seed: []
    """Renders training views by models of the other views, from (run, share of its steps, seed)
    (`RegeneratorContext.held_out`)."""


@runtime_checkable
class Augmenter(Protocol):
    """A source of pseudo views, with a schedule."""

    def term(self, run: "Run", step: int, view: int) -> Term | None:
        """Returns the term of a step for a training view; None outside the active windows.

        The first call in a window makes its pseudo views, from the current model.
        """

    def begins(self) -> int:
        """Returns the number of first steps that do not depend on this augmenter."""

    def plan(self) -> dict[str, Any]:
        """Returns the rescaled schedule in absolute steps, for log and report."""


@runtime_checkable
class Replacing(Protocol):
    """An augmenter whose terms replace a part of the photos' own loss."""

    def share(self) -> float:
        """Returns the largest part; the parts of all augmenters of a run must add up to less than 1."""


@runtime_checkable
class Accounting(Protocol):
    """An augmenter that counts the pictures it requests and loses.

    An account has `event`, the model's step at the last event, and counts by scale with the keys of
    `minibatch.sum_accounts`: requested, dropped, and warned by check.
    """

    def account(self, step: int) -> dict[str, Any]:
        """Returns the account of the pictures requested at a step; empty: none were."""

    def recall(self, accounts: Sequence[Mapping[str, Any]]) -> None:
        """Restores the accounts of a resumed run."""


@runtime_checkable
class KnownStart(Protocol):
    """Augmenter options that know the first step without a scene, for plans of many runs."""

    def begins(self, iterations: int) -> int:
        """Returns `Augmenter.begins` for a run of that length."""


def accounts_of(run: "Run", step: int) -> dict[str, dict[str, Any]]:
    """Returns the accounts of a step by augmenter, without empty ones."""
    accounting = {name: one for name, one in run.augmenters.items() if isinstance(one, Accounting)}
    accounts = {name: augmenter.account(step) for name, augmenter in accounting.items()}
    return {name: account for name, account in accounts.items() if account}


def recall_accounts(augmenters: Mapping[str, Augmenter], lines: Sequence[Mapping[str, Any]]) -> None:
    """Restores the augmenters' accounts from lines of metrics.jsonl."""
    for name, augmenter in augmenters.items():
        if isinstance(augmenter, Accounting):
            accounts = (line.get("pseudo", {}).get(name) for line in lines)
            augmenter.recall([account for account in accounts if account])
