"""RLlib's PPO with env runners on several nodes of a Ray cluster, each with a sandbox of its own.

python examples/with_rllib_cluster.py              # pip install 'ray[rllib]' torch
python examples/with_rllib_cluster.py --sandbox ray

The nodes of the cluster that RAY_ADDRESS names are started with --resources='{"environments": 1}':
one env runner is placed on each. Without a cluster, two nodes are started on this machine.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

try:
    import ray
    from ray.cluster_utils import Cluster
    from ray.rllib.algorithms.ppo import PPOConfig
except ModuleNotFoundError as error:
    raise SystemExit(f"{error}. Run: pip install 'ray[rllib]' torch") from None

CARTPOLE = str(Path(__file__).with_name("cartpole"))
REWARD = 150.0


def connect() -> int:
    """Connect to the cluster; how many of its nodes are for environments."""
    if not os.environ.get("RAY_ADDRESS"):
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
        for _ in range(2):
            cluster.add_node(num_cpus=2, resources={"environments": 1})
        os.environ["RAY_ADDRESS"] = cluster.address
    ray.init(log_to_driver=False)
    return int(ray.cluster_resources()["environments"])


def main() -> None:
    """Train until the mean return is high enough."""
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "--sandbox",
        choices=("process", "ray"),
        default="process",
        help="on the env runner's own node, or wherever Ray finds room",
    )
    sandbox = parser.parse_args().sandbox
    nodes = connect()
    config = (
        PPOConfig()
        .environment(
            "envhub_sandbox.integrations.gym:Hub-v0",
            env_config={"ref": CARTPOLE, "sandbox": sandbox},
        )
        .env_runners(
            num_env_runners=nodes,
            num_envs_per_env_runner=8,
            custom_resources_per_env_runner={"environments": 1},
            gym_env_vectorize_mode="vector_entry_point",
        )
        .training(lr=1e-3, train_batch_size_per_learner=2048, minibatch_size=256, num_epochs=10)
    )
    algorithm = config.build_algo()
    places = algorithm.env_runner_group.foreach_env_runner(
        lambda _: ray.get_runtime_context().get_node_id(), local_env_runner=False
    )
    print(f"{len(places)} env runners on {len(set(places))} nodes, sandbox={sandbox!r}", flush=True)
    for iteration in range(1, 61):
        reward = algorithm.train()["env_runners"]["episode_return_mean"]
        print(f"iteration {iteration}: mean return {reward:.1f}", flush=True)
        if reward >= REWARD:
            print(f"reached a mean return of {REWARD:.0f}")
            break
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    main()
