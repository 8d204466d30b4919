"""An environment and its reference, driven by the same seeds and actions."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from tests.support.compare import assert_same

VectorEnv = Any


@dataclass
class Pair:
    """A reference in this process and the sandboxed environment that must do the same."""

    reference: VectorEnv
    sandboxed: VectorEnv
    is_async: bool = False
    """Whether the sandboxed one stands for an ``AsyncVectorEnv``, with its order of infos."""

    @property
    def num_envs(self) -> int:
        return int(self.reference.num_envs)

    def sample_actions(self, seed: int, steps: int) -> list[Any]:
        space = self.reference.action_space
        space.seed(seed)
        return [space.sample() for _ in range(steps)]

    def reset(self, **kwargs: Any) -> Any:
        """Reset both and compare. Each gets ``options`` of its own: Gymnasium pops from it."""
        expected = self.reference.reset(**_copied(kwargs))
        actual = self.sandboxed.reset(**_copied(kwargs))
        assert_same(expected, actual, f"reset({kwargs})")
        return actual

    def step(self, actions: Any, what: str = "step") -> Any:
        expected = self.reference.step(actions)
        if self.is_async:
            expected = *expected[:-1], _in_order_of_async(expected[-1])
        actual = self.sandboxed.step(actions)
        names = ("observations", "rewards", "terminations", "truncations", "infos")
        for name, one, other in zip(names, expected, actual, strict=True):
            assert_same(one, other, f"{what}: {name}")
        return actual

    def drive(self, seed: int, steps: int) -> int:
        """Reset and step both; with autoreset disabled, reset what has ended by mask."""
        self.reset(seed=seed)
        ended = 0
        for number, actions in enumerate(self.sample_actions(seed, steps)):
            _, _, terminations, truncations, _ = self.step(actions, f"step {number}")
            done = np.logical_or(terminations, truncations)
            ended += int(done.sum())
            if done.any() and self.autoreset_mode is AutoresetMode.DISABLED:
                self.reset(options={"reset_mask": done})
        return ended

    @property
    def autoreset_mode(self) -> AutoresetMode:
        return self.reference.metadata["autoreset_mode"]


_ENDS_OF_ASYNC = ("final_info", "_final_info", "final_obs", "_final_obs")


def _in_order_of_async(infos: dict[Any, Any]) -> dict[Any, Any]:
    """``SyncVectorEnv`` has the final observation first, ``AsyncVectorEnv`` the final info."""
    ends = iter(_ENDS_OF_ASYNC)
    keys = [next(ends) if key in _ENDS_OF_ASYNC else key for key in infos]
    return {key: infos[key] for key in keys}


def _copied(kwargs: dict[str, Any]) -> dict[str, Any]:
    if isinstance(kwargs.get("options"), dict):
        return kwargs | {"options": dict(kwargs["options"])}
    return kwargs
