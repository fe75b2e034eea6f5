"""Several views in one step, on one process or several: gradients and observations of their mean loss.

Observations count by their weight in the mean loss, so that published thresholds hold for any number of views.
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
    """Restores sampler and generator and clears gradients if the step raises."""
    colours = run.generator.get_state()
    try:
        yield
    except BaseException:
        run.generator.set_state(colours)
        run.sampler.put_back()
        zero_grad(run.backbone.table)
        raise


@contextmanager
def accumulate_gradients(table: ParameterTable) -> Iterator[None]:
    """Clears gradients for the block, whose terms may drop some, and adds the earlier ones at its end."""
    before = gradients(table)
    zero_grad(table)
    yield
    for name, parameter in named_parameters(table):
        if name in before:
            parameter.grad = before[name] if parameter.grad is None else before[name].add_(parameter.grad)


@dataclass(frozen=True, kw_only=True)
class Account:
    """A rank's report to the others after its backward passes."""

    losses: list[float]
    terms: list[dict[str, float]]
    dropped: int
    learnt: set[str]
    """Names of parameters with a gradient."""
    pseudo: dict[str, dict[str, Any]]
    """Accounts of its augmenters, by name."""


def merge_gradients(run: Run, results: Sequence[StepResult]) -> StepResult:
    """Merges the results of this rank's views and of all ranks into one; gradients become those of the mean loss."""
    own = Account(
        losses=[float(result.loss) for result in results],
        terms=[result.terms for result in results],
        dropped=sum(result.dropped for result in results),
        learnt=set(gradients(run.backbone.table)),
        pseudo=results[0].pseudo,
    )
    accounts = run.ranks.all_gather(own)
    average(run, set().union(*(account.learnt for account in accounts)))
    losses = [loss for account in accounts for loss in account.losses]
    return replace(
        results[0],
        loss=torch.tensor(losses, device=run.device).mean(),
        terms=mean_terms(losses, [terms for account in accounts for terms in account.terms]),
        observations=run.ranks.gathered([one for result in results for one in result.observations], run.device),
        dropped=sum(account.dropped for account in accounts),
        others=results[1:],
        pseudo=merge_accounts([account.pseudo for account in accounts]),
    )


def average(run: Run, learnt: set[str]) -> None:
    """Turns each rank's sums of gradients into the mean over the batch, for the named parameters."""
    moved = [parameter for name, parameter in named_parameters(run.backbone.table) if name in learnt]
    for parameter in moved:
        parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
    summed = [parameter.grad for parameter in moved if parameter.grad is not None]
    run.ranks.add(summed)
    for gradient in summed:
        gradient /= run.training.batch


def mean_terms(losses: Sequence[float], terms: Sequence[dict[str, float]]) -> dict[str, float]:
    """Returns the mean over views of each part of the loss; a view without parts has the backbone's `own` alone."""
    if not any(terms):
        return {}
    whole = [parts or {"own": loss} for loss, parts in zip(losses, terms, strict=True)]
    names = dict.fromkeys(name for parts in whole for name in parts)
    return {name: sum(parts.get(name, 0.0) for parts in whole) / len(whole) for name in names}


def merge_accounts(accounts: Sequence[Mapping[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Adds up the accounts of several ranks, by augmenter (`augmenter.Accounting`)."""
    merged = {}
    for name in dict.fromkeys(name for by_name in accounts for name in by_name):
        parts = [by_name[name] for by_name in accounts if name in by_name]
        merged[name] = {"event": parts[0]["event"]} | sum_accounts(parts)
    return merged


def sum_accounts(accounts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Adds up the counts of one augmenter's accounts, by scale."""
    checks = dict.fromkeys(check for account in accounts for check in account["warned"])
    return {
        "asked": sum_by_scale(account["asked"] for account in accounts),
        "dropped": sum_by_scale(account["dropped"] for account in accounts),
        "warned": {check: sum_by_scale(account["warned"].get(check, {}) for account in accounts) for check in checks},
    }


def sum_by_scale(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Adds up counts of pictures by scale."""
    total: Counter[str] = Counter()
    for count in counts:
        total.update(count)
    return dict(sorted(total.items(), key=lambda item: float(item[0])))
