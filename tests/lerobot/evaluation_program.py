"""``lerobot-eval`` in this process and in the sandbox, by LeRobot's own ``main``; prints both.
To be run in an interpreter that has all of LeRobot, by ``kit.run``."""

import hashlib
import json
import logging
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig, HubEnvConfig, IsaaclabArenaEnv
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors
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
    sys.argv = ["lerobot-eval", *arguments, f"--output_dir={folder}"]
    sys.argv += ["--eval.n_episodes=4", "--eval.batch_size=2", "--eval.use_async_envs=false"]
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


def saved(folder: str, cfg: Any) -> str:
    """A policy that nobody has trained, as ``--policy.path`` takes one."""
    options = {key: value for key, value in ACT.items() if key != "type"}
    options |= {"use_vae": False, "push_to_hub": False, "pretrained_backbone_weights": None}
    policy = make_policy(make_policy_config("act", **options), env_cfg=cfg)
    for part in (policy, *make_pre_post_processors(policy.config)):
        part.save_pretrained(folder)
    return f"--policy.path={folder}"


def by_the_pages() -> dict[str, Any]:
    """The commands that our pages write; of Isaac Lab Arena, of which LeRobot has a configuration,
    also what LeRobot itself makes of the same repository."""
    from envhub_sandbox.integrations import lerobot_eval as ours

    lines = [words for program, *words in COMMANDS if program == "lerobot-eval"]
    jails = Opened()
    found: dict[str, Any] = {
        "pages": [
            evaluated(lerobot_eval.main, f"page {number}", *words)
            for number, words in enumerate(lines)
        ]
    }
    found["jails of plugin"] = jails.count / len(lines)
    size = ("--env.enable_cameras=true", "--env.camera_keys=front", "--env.state_dim=4")
    size += ("--env.camera_height=16", "--env.camera_width=24", "--env.action_dim=3")
    shape = {"enable_cameras": True, "camera_keys": "front", "state_dim": 4, "action_dim": 3}
    arena = IsaaclabArenaEnv(**shape, camera_height=16, camera_width=24)
    policy = saved("arena policy", arena)
    theirs = ("--env.type=isaaclab_arena", "--trust_remote_code=true", policy)
    found["arena"] = evaluated(lerobot_eval.main, "arena", *theirs, *size)
    [words] = [words for program, *words in COMMANDS if program == "lerobot-eval-sandboxed"]
    words = [policy if word.startswith("--policy.path=") else word for word in words]
    found["arena of the page"] = evaluated(ours.main, "arena of the page", *words, *size)
    return found


def own_kind() -> dict[str, Any]:
    """Our own type, by the command that this LeRobot has for it."""
    from envhub_sandbox.integrations import lerobot_eval as ours

    repo = f"--env.repo={repo_of_the_hub}"
    asks = hasattr(EnvConfig, "create_envs")
    refusal = refused(OfTheHub(hub_path=repo_of_the_hub))
    found: dict[str, Any] = {"asks configs": asks, "train before": refusal}
    if asks:
        found |= by_the_pages()
    jails = Opened()
    hub_path = f"--env.hub_path={repo_of_the_hub}"
    found["installed"] = evaluated(
        ours.main, "installed", "--env.type=of_the_hub", hub_path, POLICY
    )
    found["own"] = evaluated(
        ours.main,
        "own",
        POLICY,
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
    COMMANDS = json.loads(sys.argv[2])
    POLICY = saved("robots/policy", OfTheHub())
    here = evaluated(
        lerobot_eval.main,
        "here",
        "--env.type=of_the_hub",
        f"--env.hub_path={repo_of_the_hub}",
        "--trust_remote_code=true",
        POLICY,
    )
    executed_by_lerobot = os.environ.pop("REACHED", None) is not None
    report = {"here": here, "executed by LeRobot": executed_by_lerobot, **own_kind()}
    report["executed here"] = "REACHED" in os.environ
    print(json.dumps(report))
