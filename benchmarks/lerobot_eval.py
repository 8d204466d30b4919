"""LeRobot's own evaluation, called as ``lerobot-eval`` calls it; nothing of it is written again.

To be imported in an interpreter that has LeRobot 0.6 (``python -m benchmarks venvs lerobot``). The
policy is one linear layer and the processors do nothing, so that environments are what is measured.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

os.environ.setdefault("SLURM_JOB_ID", "0")  # it draws no progress bars there

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import utils
from lerobot.policies import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import eval_policy_all

Suites = Mapping[str, Mapping[Any, Any]]
_INSIDE = vars(utils)
"""Its make_env only takes what it downloads."""


@PreTrainedConfig.register_subclass("one_layer")
@dataclass
class OneLayerConfig(PreTrainedConfig):
    """What LeRobot asks of every policy's configuration."""

    device: str = "cpu"
    observation_delta_indices = None
    action_delta_indices = None
    reward_delta_indices = None

    def get_optimizer_preset(self) -> Any:
        """Nothing is trained."""
        raise NotImplementedError

    get_scheduler_preset = get_optimizer_preset

    def validate_features(self) -> None:
        """Any will do."""


class OneLayer(PreTrainedPolicy):
    """A linear layer of the state, with the weights of one seed."""

    config_class = OneLayerConfig
    name = "one_layer"

    def __init__(self) -> None:
        super().__init__(OneLayerConfig())
        torch.manual_seed(0)
        self.layer = torch.nn.Linear(4, 2)

    def reset(self) -> None:
        """It remembers nothing."""

    def select_action(self, batch: Mapping[str, Any], **_: Any) -> torch.Tensor:
        """Actions for a batch of observations."""
        return self.layer(batch["observation.state"])

    def get_optim_params(self) -> Any:
        """Nothing is trained."""
        raise NotImplementedError

    forward = predict_action_chunk = get_optim_params


def evaluate_all(envs: Suites, n_episodes: int) -> list[list[float]]:
    """The returns of every task's episodes, in order."""
    names = ("env_preprocessor", "env_postprocessor", "preprocessor", "postprocessor")
    nothing = {name: PolicyProcessorPipeline(steps=[]) for name in names}
    nothing["postprocessor"] = lambda action: action
    with torch.no_grad():
        found = eval_policy_all(envs, OneLayer(), n_episodes=n_episodes, start_seed=7, **nothing)
    utils.close_envs(envs)
    return [one["metrics"]["sum_rewards"] for one in found["per_task"]]


def from_hub(folder: str, n_envs: int, use_async: bool, given: Mapping[str, Any]) -> Suites:
    """What its ``make_env`` does with a repository once that lies on the disk."""
    module = _INSIDE["_import_hub_module"](os.path.join(folder, "env.py"), "benchmarks/suite")
    made = module.make_env  # it has no way to hand arguments on
    module.make_env = lambda **asked: made(**asked, **given)
    returned = _INSIDE["_call_make_env"](module, n_envs, use_async, None)
    return _INSIDE["_normalize_hub_result"](returned)


def lazily(env_fns: list[Any], like: Any) -> Any:
    """How it builds suites of its own with ``use_async_envs``: forkserver, when first used."""
    spaces = (like.observation_space, like.action_space)
    return _INSIDE["_LazyAsyncVectorEnv"](env_fns, *spaces, like.metadata)
