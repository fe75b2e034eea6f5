"""Shape annotations are checked by jaxtyping and beartype; an int is accepted where a float is asked for.

A function is checked at its first calls in every test and at some of those that follow: steps of a run repeat the same
shapes, and checking each of them took as long as the steps.
"""

from collections import Counter
from collections.abc import Callable
from functools import wraps
from itertools import count
from types import FunctionType
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

FIRST, EVERY = 2, 64
"""Calls in a test that are checked, and every EVERY-th of the others."""

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
calls: Counter[int] = Counter()
"""By function, in the test under way; conftest.py clears it."""
numbers = count()
always = jaxtyping.jaxtyped


def sometimes(*, typechecker: Any) -> Callable[[Any], Any]:
    """`jaxtyping.jaxtyped` for the import hook: functions are checked at some of their calls, classes at all."""

    def decorated(target: Any) -> Any:
        checked, number = always(typechecker=typechecker)(target), next(numbers)
        if not isinstance(target, FunctionType):
            return checked

        @wraps(target)
        def either(*given: Any, **named: Any) -> Any:
            done = calls[number]
            calls[number] = done + 1
            return (checked if done < FIRST or done % EVERY == 0 else target)(*given, **named)

        return either

    return decorated
