"""Packages of environments: what each registers, in Gymnasium's own vector environment."""

from typing import Any

from compared import ENV, folder, report
from gymnasium.vector import SyncVectorEnv

from envhub_sandbox import make_env

STEPS = 200
IDS = {
    "highway-env": ("import highway_env", "highway-fast-v0"),
    "gymnasium-robotics": (
        "import gymnasium_robotics\ngym.register_envs(gymnasium_robotics)",
        "PointMaze_UMaze-v3",
    ),
    "dm_control by shimmy": (
        "import shimmy\ngym.register_envs(shimmy)",
        "dm_control/cartpole-swingup-v0",
    ),
}


def played(repository: str, env_py: str, sandboxed: bool) -> list[Any]:
    """A reset and steps, with the actions that its space draws."""
    names: dict[str, Any] = {}
    exec(env_py, names)
    here: SyncVectorEnv = names["make_env"](n_envs=2)
    envs: Any = make_env(repository, n_envs=2).env if sandboxed else here
    here.action_space.seed(0)
    seen: list[Any] = [envs.reset(seed=1)[0]]
    seen += [envs.step(here.action_space.sample())[:4] for _ in range(STEPS)]
    envs.close()
    return seen


if __name__ == "__main__":
    for package, (imports, env_id) in IDS.items():
        text = ENV.replace("import gymnasium as gym\n", f"import gymnasium as gym\n{imports}\n")
        text = text.replace("CartPole-v1", env_id)
        made = folder(text)
        report(package, STEPS, lambda sandboxed, m=made, t=text: played(m, t, sandboxed))
