"""What the worker's own loop over sub-environments makes of options and of infos."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from envhub_worker.protocol.spaces import batches
from envhub_worker.runner.sync_envs import NEW_ROLLOUT, SubEnvs, announces_rollout


@pytest.mark.parametrize("options", [None, {}, {NEW_ROLLOUT: False}, [NEW_ROLLOUT], NEW_ROLLOUT])
def test_other_options_announce_nothing(options: Any) -> None:
    assert announces_rollout({NEW_ROLLOUT: True})
    assert not announces_rollout(options)


def test_a_slice_joins_what_loses_nothing() -> None:
    """What is no array by itself may be one among others."""
    pairs: list[tuple[int, dict[Any, Any]]] = [(0, {"a": 1}), (1, {"a": "text"})]
    make = [lambda: gym.make("CartPole-v1")] * 2
    with pytest.raises(ValueError, match="info 'a' of sub-environment 1"):
        SubEnvs(make, "NextStep", sync=True).joined(pairs)
    sliced = SubEnvs(make, "NextStep", sync=True, sliced=True)
    assert sliced.joined(pairs) == dict(pairs)
    columns = sliced.joined(
        [(0, {"a": 1, "b": np.float32(0.5)}), (1, {"a": 2, "b": np.float32(2)})]
    )
    assert columns[batches.APART_CLASSES] == {"a": False, "b": True}
    assert columns["a"].tolist() == [1, 2]


class Fails(gym.Env[Any, Any]):
    """Each step ends an episode. Its reset raises, or its info is not like its siblings'."""

    observation_space = gym.spaces.Discrete(99)
    action_space = gym.spaces.Discrete(2)
    failing = ""
    count = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.count += 10
        if self.failing == "reset":
            raise RuntimeError("no reset")
        return self.count, {}

    def step(self, action: Any) -> Any:
        self.count += 1
        return self.count, 0.0, True, False, {"a": "text" if self.failing == "infos" else 1}


@pytest.mark.parametrize(
    ("failing", "mode"), [("reset", "SameStep"), ("infos", "Disabled"), ("infos", "NextStep")]
)
def test_it_goes_on_after_a_failure_as_gymnasium_does(failing: str, mode: str) -> None:
    """An autoreset that raises leaves the last observation; a step whose infos cannot be joined
    leaves no episode that has ended."""
    ours = SubEnvs([Fails, Fails], mode, sync=True)
    theirs = SyncVectorEnv([Fails, Fails], autoreset_mode=AutoresetMode(mode))
    ours.run_reset(None, None, None)
    theirs.reset()
    for env in (ours, theirs):
        env.envs[1].failing = failing
    with pytest.raises((RuntimeError, ValueError)) as expected:
        theirs.step([0, 0])
    with pytest.raises(expected.type):
        ours.joined(ours.run_step(np.zeros(2, int)))
    for env in (ours, theirs):
        env.envs[1].failing = ""
    if failing == "infos":
        ours.joined(ours.run_step(np.zeros(2, int)))
        observation = theirs.step([0, 0])[0]
    else:
        mask = np.array([True, False])
        ours.run_reset(None, None, mask)
        observation = theirs.reset(options={"reset_mask": mask})[0]
    assert ours.batch.observation().tolist() == observation.tolist()
