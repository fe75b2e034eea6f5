#!/usr/bin/env bash
# Packages: beartype 0.23.1 and hypothesis 6.170.15 (PyPI).
# Input: a strategy that calls a function whose list argument beartype checks, as jaxtyping's import hook makes of a
#   whole package. The function itself draws nothing.
# Expected: a check of types has no effect on the search; strategies that draw nothing of their own are accepted.
# Behaviour: beartype checks one item of a list, chosen by Python's global generator. Its state differs after the
#   strategy, so hypothesis says that the strategy uses `random`, which is deprecated. With a tuple it does not.
# Output seen:
#   list: HypothesisDeprecationWarning: Do not use the `random` module inside strategies
#   tuple: no warning
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet beartype==0.23.1 hypothesis==6.170.15
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import sys
import warnings

from beartype import beartype
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.errors import HypothesisDeprecationWarning


@beartype
def of_list(sizes: list[int]) -> int:
    return len(sizes)


@beartype
def of_tuple(sizes: tuple[int, int, int]) -> int:
    return len(sizes)


def outcome(strategy):
    @settings(max_examples=5, database=None)
    @given(strategy)
    def search(count):
        assert count == 3

    with warnings.catch_warnings():
        warnings.simplefilter("error", HypothesisDeprecationWarning)
        try:
            search()
        except HypothesisDeprecationWarning as warning:
            return f"{type(warning).__name__}: {str(warning).partition(';')[0]}"
    return "no warning"


found = {
    "list": outcome(st.builds(of_list, st.just([1, 2, 3]))),
    "tuple": outcome(st.builds(of_tuple, st.just((1, 2, 3)))),
}
for kind, words in found.items():
    print(f"{kind}: {words}")
sys.exit(0 if found["list"].startswith("HypothesisDeprecationWarning") and found["tuple"] == "no warning" else 1)
PYTHON
