"""TorchRL's ``GymWrapper`` takes a sandboxed environment as it is, also in the example."""

from __future__ import annotations

import pytest

from tests.support.command_line import python
from tests.support.samples import EXAMPLES, sample

pytestmark = pytest.mark.same_for("users")

pytest.importorskip("torch")
pytest.importorskip("torchrl")

# in a process of its own: importing it sets up warnings and logs for everybody
_SCRIPT = """
import runpy
import sys
import torch
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs
from envhub_sandbox import SandboxEnv, make_env

def check(env):
    check_env_specs(env)
    torch.manual_seed(0)
    env.set_seed(0)
    rollout = env.rollout(120, break_when_any_done=False)
    assert torch.isfinite(rollout["observation"]).all()
    assert rollout["next", "done"].sum() > 0
    env.close()
    return [*rollout.batch_size]

if __name__ == "__main__":
    folder, example = sys.argv[1:]
    runpy.run_path(example, run_name="__main__")
    print("one", check(GymWrapper(SandboxEnv(folder))))
    for mode in ("SameStep", "Disabled"):
        suites = make_env(folder, n_envs=3, env_kwargs={"autoreset_mode": mode})
        print(mode, check(GymWrapper(suites.env)))
"""


def test_its_wrapper_passes_its_own_check() -> None:
    """One environment, and vector environments in the modes that it takes; episodes end."""
    done = python("-c", _SCRIPT, sample("cartpole"), EXAMPLES / "with_torchrl.py")
    assert "a rollout of 40 steps" in done.stdout
    said = done.stdout.splitlines()  # it logs there, too
    assert {"one [120]", "SameStep [3, 120]", "Disabled [3, 120]"} <= set(said)
