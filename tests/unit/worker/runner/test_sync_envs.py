"""What the worker's own loop over sub-environments makes of options and of infos."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import pytest

from envhub_worker.protocol.spaces import batches
from envhub_worker.runner.sync_envs import NEW_ROLLOUT, SubEnvs, announces_rollout


@pytest.mark.parametrize("options", [None, {}, {NEW_ROLLOUT: False}, [NEW_ROLLOUT], NEW_ROLLOUT])
def test_other_options_announce_nothing(options: Any) -> None:
    assert announces_rollout({NEW_ROLLOUT: True})
    assert not announces_rollout(options)


def test_a_slice_says_what_it_cannot_join() -> None:
    """What is no array by itself may be one among others: those are to be asked apart."""
    pairs: list[tuple[int, dict[Any, Any]]] = [(0, {"a": 1}), (1, {"a": "text"})]
    make = [lambda: gym.make("CartPole-v1")] * 2
    with pytest.raises(ValueError, match="info 'a' of sub-environment 1"):
        SubEnvs(make, "NextStep", sync=True).joined(pairs)
    assert SubEnvs(make, "NextStep", sync=True, sliced=True).joined(pairs) == batches.APART
