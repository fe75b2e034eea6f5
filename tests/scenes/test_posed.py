"""What files of poses share."""

import re
from pathlib import Path

import pytest

from gsx.core.errors import InputError
from gsx.scenes.pose_files import refuse_partial


@pytest.mark.parametrize("count", [1, 3, 7, 100, 311])
def test_the_share_that_an_error_names_is_enough(count: int) -> None:
    """Rounded down, or compared as 29 > 0.29 * 100, it would be refused again."""
    for absent in range(1, count + 1):
        names = [f"{number}.png" for number in range(absent)]
        with pytest.raises(InputError, match=rf"{absent} of the {count} images") as refusal:
            refuse_partial(names, count, Path("scene"), 0.0)
        share = re.search(r"scene\.missing=([\d.]+) or more", str(refusal.value))
        assert share is not None
        refuse_partial(names, count, Path("scene"), float(share[1]))
