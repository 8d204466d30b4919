"""A rollout by TorchRL, of a sandboxed repository.

python examples/with_torchrl.py            # pip install torchrl
"""

from __future__ import annotations

from pathlib import Path

from torchrl.envs import GymWrapper

from envhub_sandbox import SandboxEnv

if __name__ == "__main__":
    env = GymWrapper(SandboxEnv(Path(__file__).with_name("cartpole")))
    rollout = env.rollout(40, break_when_any_done=False)
    print(f"a rollout of {rollout.batch_size[0]} steps, with {', '.join(sorted(rollout.keys()))}")
    env.close()
