"""The multi-task example of LeRobot's EnvHub documentation, with the tasks it takes for granted."""

import gymnasium as gym

for task, env_id in {1: "CartPole-v1", 2: "Acrobot-v1", 3: "Pendulum-v1"}.items():
    gym.register(f"Task{task}-v0", entry_point=gym.spec(env_id).entry_point, max_episode_steps=50)


def make_env(n_envs: int = 1, use_async_envs: bool = False):
    env_cls = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv

    # Return dict: {suite_name: {task_id: VectorEnv}}
    return {
        "suite_1": {
            0: env_cls([lambda: gym.make("Task1-v0") for _ in range(n_envs)]),
            1: env_cls([lambda: gym.make("Task2-v0") for _ in range(n_envs)]),
        },
        "suite_2": {0: env_cls([lambda: gym.make("Task3-v0") for _ in range(n_envs)])},
    }
