"""Several views in one step, on one process or on several: gradients, losses and observations become those of one.

Every view's own loss is sent back, and the sums are divided in the end. An observation counts by its weight in the
mean loss (`backbones.density`), so that published thresholds hold for any number of views.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch

from gsx.core.training.parameter_table import ParameterTable, gradients, named_parameters, zero_grad
from gsx.core.training.run import Run, StepResult


@contextmanager
def rollback_on_error(run: Run) -> Iterator[None]:
    """A step that fails has not been taken: a checkpoint written then begins with the same views and colours again."""
    colours = run.generator.get_state()
    try:
        yield
    except BaseException:
        run.generator.set_state(colours)
        run.sampler.put_back()
        zero_grad(run.backbone.table)
        raise


@contextmanager
def gradients_added(table: ParameterTable) -> Iterator[None]:
    """A view begins without gradients, because its terms may forget some, and ends with the sums of all so far."""
    before = gradients(table)
    zero_grad(table)
    yield
    for name, parameter in named_parameters(table):
        if name in before:
            parameter.grad = before[name] if parameter.grad is None else before[name].add_(parameter.grad)


@dataclass(frozen=True, kw_only=True)
class Account:
    """What a rank tells the others of its views after their backward passes."""

    losses: list[float]
    terms: list[dict[str, float]]
    dropped: int
    learnt: set[str]
    """Parameters that have a gradient."""
    pseudo: dict[str, dict[str, Any]]
    """Accounts of the pictures that its augmenters requested."""


def merge_gradients(run: Run, steps: Sequence[StepResult]) -> StepResult:
    """The step of the whole batch, from steps of this rank's views; the gradients become those of the mean loss."""
    own = Account(
        losses=[float(step.loss) for step in steps],
        terms=[step.terms for step in steps],
        dropped=sum(step.dropped for step in steps),
        learnt=set(gradients(run.backbone.table)),
        pseudo=steps[0].pseudo,
    )
    accounts = run.ranks.all_gather(own)
    average(run, set().union(*(account.learnt for account in accounts)))
    losses = [loss for account in accounts for loss in account.losses]
    return replace(
        steps[0],
        loss=torch.tensor(losses, device=run.device).mean(),
        terms=mean_terms(losses, [terms for account in accounts for terms in account.terms]),
        seen=run.ranks.gathered([seen for step in steps for seen in step.seen], run.device),
        dropped=sum(account.dropped for account in accounts),
        others=steps[1:],
        pseudo=merge_accounts([account.pseudo for account in accounts]),
    )


def average(run: Run, learnt: set[str]) -> None:
    """Turn sums of gradients on each rank into the mean over the batch on all; `learnt`: parameters that have any."""
    moved = [parameter for name, parameter in named_parameters(run.backbone.table) if name in learnt]
    for parameter in moved:
        parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
    summed = [parameter.grad for parameter in moved if parameter.grad is not None]
    run.ranks.add(summed)
    for gradient in summed:
        gradient /= run.training.batch


def mean_terms(losses: Sequence[float], terms: Sequence[dict[str, float]]) -> dict[str, float]:
    """Mean of every part of the loss over views; those without parts have the backbone's own alone. None: no parts."""
    if not any(terms):
        return {}
    whole = [parts or {"own": loss} for loss, parts in zip(losses, terms, strict=True)]
    names = dict.fromkeys(name for parts in whole for name in parts)
    return {name: sum(parts.get(name, 0.0) for parts in whole) / len(whole) for name in names}


def merge_accounts(accounts: Sequence[Mapping[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Merges the accounts of several ranks into one, by augmenter (`augmenter.Accounting`)."""
    merged = {}
    for name in dict.fromkeys(name for by_name in accounts for name in by_name):
        parts = [by_name[name] for by_name in accounts if name in by_name]
        checks = dict.fromkeys(check for part in parts for check in part["warned"])
        merged[name] = {
            "event": parts[0]["event"],
            "asked": sum_by_scale(part["asked"] for part in parts),
            "dropped": sum_by_scale(part["dropped"] for part in parts),
            "warned": {check: sum_by_scale(part["warned"].get(check, {}) for part in parts) for check in checks},
        }
    return merged


def sum_by_scale(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Adds counts of pictures up by scale."""
    total: Counter[str] = Counter()
    for count in counts:
        total.update(count)
    return dict(sorted(total.items(), key=lambda item: float(item[0])))
