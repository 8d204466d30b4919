"""The examples for other libraries run as their first lines say; RLlib's and LeRobot's by hand."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.support.command_line import python
from tests.support.samples import EXAMPLES, sample

PRINTED = {
    "with_cleanrl.py": "the weights are the same, to the last bit: True",
    "with_cleanrl_async.py": "episodes: the first last",
    "with_sb3.py": "trained for 512 steps",
    "with_torchrl.py": "a rollout of 40 steps",
}
# one after the other in one process, since to import torch takes longer than to run them; not in
# ours, where importing TorchRL would set up warnings and logs for everybody
_PROGRAM = f"""
import runpy, sys
for path in sys.argv[1:]:
    runpy.run_path(path, run_name="__main__")
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
    folder = {str(sample("cartpole"))!r}
    print("one", check(GymWrapper(SandboxEnv(folder))))
    for mode in ("SameStep", "Disabled"):
        suites = make_env(folder, n_envs=3, env_kwargs={{"autoreset_mode": mode}})
        print(mode, check(GymWrapper(suites.env)))
"""


@pytest.mark.timeout(900)  # it imports torch, which a loaded machine does slowly
def test_example_scripts(tmp_path: Path) -> None:
    """Each ends well and prints what it promises. One environment, and vector environments in the
    modes that TorchRL takes, pass its own check; episodes end."""
    for needed in ("torch", "stable_baselines3", "torchrl"):
        if find_spec(needed) is None:  # to import TorchRL makes all later processes spawned ones
            pytest.skip(f"needs {needed}")
    scripts = [EXAMPLES / name for name in PRINTED]
    done = python("-c", _PROGRAM, *scripts, ENVHUB_CACHE=str(tmp_path / "cache"))
    assert [printed for printed in PRINTED.values() if printed not in done.stdout] == []
    said = done.stdout.splitlines()  # it logs there, too
    assert {"one [120]", "SameStep [3, 120]", "Disabled [3, 120]"} <= set(said)
