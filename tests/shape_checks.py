"""Shape annotations are checked by jaxtyping and beartype; an int is accepted where a float is asked for.

A function is checked at its first call in every test and at some of those that follow, and so is a data class when it
is made: steps of a run repeat the same shapes, and checking each of them took as long as the steps. What checks it is
made when it is first called.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import cache, wraps
from itertools import count
from types import FunctionType
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

EVERY = 256
"""In a test every EVERY-th call of a function is checked, from the first on."""

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
calls: Counter[int] = Counter()
"""By function, in the test under way; conftest.py clears it."""
numbers = count()
always = jaxtyping.jaxtyped


def sometimes(*, typechecker: Any) -> Callable[[Any], Any]:
    """`jaxtyping.jaxtyped` for the import hook: functions are checked at some of their calls, and so are data classes
    when they are made."""

    def decorated(target: Any) -> Any:
        if is_dataclass(target) and "__init__" in vars(target):
            target.__init__ = decorated(target.__init__)
        if not isinstance(target, FunctionType):
            return target
        checked, number = cache(lambda: always(typechecker=typechecker)(target)), next(numbers)

        @wraps(target)
        def either(*given: Any, **named: Any) -> Any:
            done = calls[number]
            calls[number] = done + 1
            return (target if done % EVERY else checked())(*given, **named)

        return either

    return decorated
