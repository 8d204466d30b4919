"""RLlib's PPO on a sandboxed repository, in both of its modes.

python examples/with_rllib.py            # pip install 'ray[rllib]' torch

By default RLlib makes each environment by itself: a jail each. With ``vector_entry_point`` each of
its env runners makes one vector environment.
"""

from __future__ import annotations

from pathlib import Path

try:
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig
except ModuleNotFoundError as error:
    raise SystemExit(f"{error}. Run: pip install 'ray[rllib]' torch") from None

CARTPOLE = str(Path(__file__).with_name("cartpole"))

if __name__ == "__main__":
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    for mode in ("sync", "vector_entry_point"):
        config = PPOConfig().environment(
            "envhub_sandbox.integrations.gym:Hub-v0", env_config={"ref": CARTPOLE}
        )
        config.env_runners(
            num_env_runners=0, num_envs_per_env_runner=2, gym_env_vectorize_mode=mode
        )
        config.training(train_batch_size_per_learner=64, minibatch_size=32, num_epochs=1)
        algorithm = config.build_algo()
        sampled = algorithm.train()["env_runners"]["num_env_steps_sampled"]
        print(f"{mode}: trained on {sampled:.0f} steps", flush=True)
        algorithm.stop()
    ray.shutdown()
