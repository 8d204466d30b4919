"""``lerobot-eval`` in this process and in the sandbox, by LeRobot's own ``main``; prints both.

To be run in an interpreter that has all of LeRobot, by ``kit.run``.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig, HubEnvConfig
from lerobot.scripts import lerobot_eval, lerobot_train

PLUGIN = "--env.discover_packages_path=envhub_sandbox.integrations.lerobot"
ACT = {
    "type": "act",
    "device": "cpu",
    "chunk_size": 3,
    "n_action_steps": 3,
    "dim_model": 16,
    "n_heads": 2,
    "dim_feedforward": 16,
    "n_encoder_layers": 1,
    "use_vae": "false",
    "push_to_hub": "false",
}
FEATURES = {
    "action": PolicyFeature(type=FeatureType.ACTION, shape=(2,)),
    "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(2,)),
    "environment_state": PolicyFeature(type=FeatureType.ENV, shape=(2,)),
}
NAMES = {
    "action": "action",
    "agent_pos": "observation.state",
    "environment_state": "observation.environment_state",
}


@EnvConfig.register_subclass("of_the_hub")
@dataclass
class OfTheHub(HubEnvConfig):
    """What somebody writes who has a repository of the Hub evaluated."""

    features: dict[str, PolicyFeature] = field(default_factory=lambda: dict(FEATURES))
    features_map: dict[str, str] = field(default_factory=lambda: dict(NAMES))


class Opened(logging.Handler):
    """Counts the jails that are opened."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        logging.getLogger("envhub_sandbox.worker").addHandler(self)
        logging.getLogger("envhub_sandbox.worker").setLevel(logging.DEBUG)

    def emit(self, record: logging.LogRecord) -> None:
        self.count += "opened" in record.getMessage()


def evaluated(main: Any, name: str, *arguments: str) -> dict[str, Any]:
    """The metrics of every task, and the videos."""
    folder = Path(name)
    sys.argv = ["lerobot-eval", *(f"--policy.{key}={value}" for key, value in ACT.items())]
    sys.argv += ["--eval.n_episodes=4", "--eval.batch_size=2", "--eval.use_async_envs=false"]
    sys.argv += [f"--output_dir={folder}", *arguments]
    main()
    told = json.loads((folder / "eval_info.json").read_text())
    metrics = [
        {key: one["metrics"][key] for key in ("sum_rewards", "max_rewards", "successes")}
        for one in told["per_task"]
    ]
    videos = {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*.mp4"))
    }
    return {"metrics": metrics, "videos": videos}


def refused(cfg: Any) -> str:
    try:
        lerobot_train.make_env(cfg, n_envs=1, use_async_envs=False)["hub_env"][0].close()
    except RuntimeError as error:
        return str(error)
    return "made"


def own_kind() -> dict[str, Any]:
    """Our own type, by the command that this LeRobot has for it."""
    from envhub_sandbox.integrations import lerobot_eval as ours

    repo = f"--env.repo={repo_of_the_hub}"
    asks = hasattr(EnvConfig, "create_envs")
    found: dict[str, Any] = {"asks configs": asks}
    jails = Opened()
    if asks:
        found["plugin"] = evaluated(
            lerobot_eval.main, "plugin", PLUGIN, "--env.type=envhub_sandbox", repo
        )
        found["jails of plugin"] = jails.count
    found["train before"] = refused(OfTheHub(hub_path=repo_of_the_hub))
    found["installed"] = evaluated(
        ours.main, "installed", "--env.type=of_the_hub", f"--env.hub_path={repo_of_the_hub}"
    )
    found["own"] = evaluated(
        ours.main,
        "own",
        "--env.type=envhub_sandbox",
        repo,
        "--env.num_workers=1",
        '--env.policy={"network": "loopback"}',
        '--sandbox.timeouts={"startup_s": 200}',
    )
    found["train after"] = refused(OfTheHub(hub_path=repo_of_the_hub))
    found["jails"] = jails.count
    return found


if __name__ == "__main__":
    repo_of_the_hub = sys.argv[1]
    here = evaluated(
        lerobot_eval.main,
        "here",
        "--env.type=of_the_hub",
        f"--env.hub_path={repo_of_the_hub}",
        "--trust_remote_code=true",
    )
    executed_by_lerobot = os.environ.pop("REACHED", None) is not None
    report = {"here": here, "executed by LeRobot": executed_by_lerobot, **own_kind()}
    report["executed here"] = "REACHED" in os.environ
    print(json.dumps(report))
