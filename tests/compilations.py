"""Whether anything is compiled, or fetched from the disk, while something is done."""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import torch

from gsx.engine.compile_cache import CachedFunction


@contextmanager
def new_code() -> Iterator[list[str]]:
    """Names of the functions for which code is made or loaded from now on, by whichever way."""
    names, find = list[str](), CachedFunction.find

    def found(self: CachedFunction, *given: object) -> object:
        names.append(self.function.__name__)
        return find(self, *given)

    graphs = torch._dynamo.utils.counters["stats"]["unique_graphs"]
    with patch.object(CachedFunction, "find", found):
        yield names
    names += ["of torch"] * (torch._dynamo.utils.counters["stats"]["unique_graphs"] - graphs)
