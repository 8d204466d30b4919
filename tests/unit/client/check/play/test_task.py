"""What of one sub-environment's step is no finding, and what is."""

from typing import Any

import numpy as np
import pytest

from tests.support import inside


@pytest.mark.parametrize(
    ("result", "wrong"),
    [
        ((1.0, True, False, {}), ""),
        ((1, np.False_, False, {}), ""),
        ((np.float32(1), False, False, {}), ""),
        ((np.zeros(3), False, False, {}), ""),  # several objectives, as mo-gymnasium's
        ((np.zeros(1), False, False, {}), "the reward"),
        (("1", False, False, {}), "the reward"),
        ((1.0, 1, False, {}), "terminated"),
        ((1.0, False, np.zeros(1, bool), {}), "truncated"),
        ((1.0, False, False, []), "the info"),
    ],
)
def test_a_step_has_the_types_of_gymnasium(result: tuple[Any, ...], wrong: str) -> None:
    found = " ".join(text for _, text in inside.wrong_types(*result))
    assert found.startswith(wrong)
    assert bool(found) is bool(wrong)
