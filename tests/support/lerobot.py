"""What ``lerobot-eval`` does to vector environments, without LeRobot.
Followed, call by call: ``lerobot.scripts.lerobot_eval`` (``rollout``, ``eval_policy``,
``eval_policy_all``), ``lerobot.envs.utils`` (``check_env_attributes_and_types``, ``close_envs``).
"""

import concurrent.futures
import threading
from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
import torch

Policy = Callable[[dict[str, Any]], torch.Tensor]


def rollout(
    env: Any, policy: Policy, seeds: list[int] | None, frames: list[Any] | None
) -> dict[str, Any]:
    """Step all sub-environments until each has been done once; None renders nothing."""
    observation, _ = env.reset(seed=seeds, options={"lerobot_new_rollout": True})
    if frames is not None:
        frames.append(_render(env))
    kept: dict[str, list[Any]] = {key: [] for key in ("action", "reward", "success", "done")}
    observations, tasks = [], []
    done = np.array([False] * env.num_envs)
    max_steps = env.call("_max_episode_steps")[0]
    for name in ("task_description", "task"):
        has_attribute(env, name)
    step = 0
    while not np.all(done) and step < max_steps:
        prepared = {"observation.state": torch.from_numpy(observation["agent_pos"]).float()}
        observations.append(deepcopy(prepared))
        tasks.append(tasks_of(env))
        with torch.inference_mode():
            action = policy(prepared | {"task": tasks[-1]})
        action_numpy = action.to("cpu").numpy()
        assert action_numpy.ndim == 2
        observation, reward, terminated, truncated, info = env.step(action_numpy)
        if frames is not None:
            frames.append(_render(env))
        done = terminated | truncated | done
        if step + 1 == max_steps:
            done = np.ones_like(done, dtype=bool)
        kept["action"].append(torch.from_numpy(action_numpy))
        kept["reward"].append(torch.from_numpy(reward))
        kept["done"].append(torch.from_numpy(done))
        kept["success"].append(torch.tensor(_successes(info, env.num_envs)))
        step += 1
    stacked = {key: torch.stack(values, dim=1) for key, values in kept.items()}
    return stacked | {"observation": observations, "task": tasks}


def evaluate(
    env: Any, policy: Policy, n_episodes: int, start_seed: int, *, render: bool = True
) -> dict[str, Any]:
    """Metrics of ``n_episodes`` episodes, ``num_envs`` at a time, and the first frames."""
    n_batches = -(-n_episodes // env.num_envs)
    returns: list[float] = []
    successes: list[bool] = []
    frames: list[Any] | None = [] if render else None
    for batch in range(n_batches):
        first = start_seed + batch * env.num_envs
        data = rollout(env, policy, list(range(first, first + env.num_envs)), frames)
        n_steps = data["done"].shape[1]
        ends = torch.argmax(data["done"].to(torch.int), dim=1)
        mask = (torch.arange(n_steps) <= ends[:, None] + 1).int()
        returns.extend((data["reward"] * mask).sum(1).tolist())
        successes.extend((data["success"] * mask).any(1).tolist())
    return {
        "returns": returns[:n_episodes],
        "successes": successes[:n_episodes],
        "fps": env.unwrapped.metadata["render_fps"],
        "frames": None if frames is None else np.stack(frames[:5]),
    }


def evaluate_all(
    envs: Mapping[str, Mapping[Any, Any]],
    policy: Policy,
    n_episodes: int,
    max_parallel_tasks: int,
    *,
    render: bool = True,
) -> dict[tuple[str, Any], dict[str, Any]]:
    tasks = [(suite, task, env) for suite, group in envs.items() for task, env in group.items()]
    if max_parallel_tasks <= 1:
        return _one_by_one(tasks, policy, n_episodes, render)
    results = {}
    with concurrent.futures.ThreadPoolExecutor(max_workers=max_parallel_tasks) as pool:
        futures = {
            pool.submit(evaluate, env, policy, n_episodes, 7, render=render): (suite, task, env)
            for suite, task, env in tasks
        }
        for future in concurrent.futures.as_completed(futures):
            suite, task, env = futures[future]
            try:
                results[suite, task] = future.result()
            finally:
                env.close()
    return results


def close_envs(envs: Mapping[Any, Any]) -> None:
    for value in envs.values():
        if isinstance(value, Mapping):
            close_envs(value)
        elif hasattr(value, "close"):
            value.close()


def _one_by_one(tasks: Any, policy: Policy, n_episodes: int, render: bool) -> dict[Any, Any]:
    results: dict[Any, Any] = {}
    prefetch: threading.Thread | None = None
    for index, (suite, task, env) in enumerate(tasks):
        if prefetch is not None:
            prefetch.join()
            prefetch = None
        try:
            results[suite, task] = evaluate(env, policy, n_episodes, 7, render=render)
        finally:
            env.close()
            following = tasks[index + 1][2] if index + 1 < len(tasks) else None
            if following is not None and hasattr(following, "_ensure"):
                prefetch = threading.Thread(target=following._ensure, daemon=True)
                prefetch.start()
    return results


def has_attribute(env: Any, name: str) -> bool:
    """Whether it is there, for somebody who takes any error for a no."""
    try:
        env.get_attr(name)
    except Exception:
        return False
    return True


def tasks_of(env: Any) -> list[str]:
    """What each sub-environment says that its task is, or nothing."""
    for name in ("task_description", "task"):
        try:
            return list(env.call(name))
        except (AttributeError, NotImplementedError):
            continue
    return [""] * int(env.num_envs)


def _render(env: Any) -> Any:
    if isinstance(env, gym.vector.SyncVectorEnv):
        return np.stack([one.render() for one in env.envs])
    return np.stack(env.call("render")[: env.num_envs])


def _successes(info: dict[str, Any], num_envs: int) -> list[bool]:
    if "final_info" in info:
        final = info["final_info"]
        if isinstance(final, dict):
            found = final.get("is_success", [False] * num_envs)
            return found.tolist() if hasattr(found, "tolist") else [bool(found)] * num_envs
        return [bool(isinstance(item, dict) and item.get("is_success")) for item in final]
    if "is_success" in info:
        return list(info["is_success"].tolist())
    return [False] * num_envs
