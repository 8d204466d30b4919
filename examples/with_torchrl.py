"""A rollout by TorchRL, of a sandboxed repository.

python examples/with_torchrl.py            # pip install torchrl
"""

from __future__ import annotations

from pathlib import Path

from envhub_sandbox import SandboxEnv

try:
    from torchrl.envs import GymWrapper
except ModuleNotFoundError as error:
    raise SystemExit(f"{error}. Run: pip install torchrl") from None

if __name__ == "__main__":
    env = GymWrapper(SandboxEnv(Path(__file__).with_name("cartpole")))
    rollout = env.rollout(40, break_when_any_done=False)
    print(f"a rollout of {rollout.batch_size[0]} steps, with {', '.join(sorted(rollout.keys()))}")
    env.close()
