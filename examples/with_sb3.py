"""Stable-Baselines3's PPO on a sandboxed repository.

python examples/with_sb3.py            # pip install 'envhub-sandbox[sb3]'
"""

from __future__ import annotations

from pathlib import Path

try:
    from stable_baselines3 import PPO

    from envhub_sandbox.integrations.sb3 import SandboxVecEnv
except ModuleNotFoundError as error:
    raise SystemExit(f"{error}. Run: pip install stable-baselines3") from None

if __name__ == "__main__":
    env = SandboxVecEnv.make(Path(__file__).with_name("cartpole"), n_envs=4)
    model = PPO("MlpPolicy", env, n_steps=64, n_epochs=2, device="cpu").learn(512)
    print(f"trained for {model.num_timesteps} steps")
    env.close()
