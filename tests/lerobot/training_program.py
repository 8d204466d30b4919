"""``lerobot-train`` by its ``main``, evaluating in this process and in the sandbox; prints both.
To be run in an interpreter that has all of LeRobot, by ``kit.run``."""

import hashlib
import json
import os
import sys
from dataclasses import dataclass, field
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs.types import PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.scripts import lerobot_train

from tests.lerobot.evaluation_program import ACT, FEATURES, NAMES, PLUGIN

STEPS = 4
TOLD: list[dict[str, Any]] = []


@EnvConfig.register_subclass("of_this_process")
@dataclass
class OfThisProcess(EnvConfig):
    """The control: the same file as one of LeRobot's own environments, which run in its process."""

    features: dict[str, PolicyFeature] = field(default_factory=lambda: dict(FEATURES))
    features_map: dict[str, str] = field(default_factory=lambda: dict(NAMES))
    file: str = ""
    fps: int = 20

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, Any]:
        """What the file's ``make_env`` returns."""
        spec = spec_from_file_location("env_of_this_process", self.file)
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        return {"hub_env": {0: module.make_env(n_envs, use_async_envs)}}


def recorded(root: Path) -> None:
    """A dataset of two short episodes, as somebody would have recorded them."""
    vector = {"dtype": "float32", "shape": (2,), "names": None}
    names = ("observation.state", "observation.environment_state", "action")
    dataset = LeRobotDataset.create(
        "robots/recorded", fps=20, features=dict.fromkeys(names, vector), root=root
    )
    generator = np.random.default_rng(0)
    for _ in range(2):
        for _ in range(12):
            drawn = {name: generator.uniform(-1, 1, 2).astype(np.float32) for name in names}
            dataset.add_frame({**drawn, "task": "reach the goal"})
        dataset.save_episode()
    dataset.finalize()


def trained(name: str, *arguments: str) -> dict[str, Any]:
    """What a training leaves: its evaluations, their videos, and its weights."""
    folder = Path(name)
    TOLD.clear()
    sizes = {key: value for key, value in ACT.items() if key != "push_to_hub"}
    sys.argv = ["lerobot-train", *arguments, f"--dataset.root={Path('recorded')}"]
    sys.argv += [f"--policy.{key}={value}" for key, value in sizes.items()]
    sys.argv += [f"--steps={STEPS}", "--env_eval_freq=2", "--save_freq=2", "--log_freq=1"]
    sys.argv += ["--batch_size=4", "--num_workers=0", "--seed=7", "--eval.use_async_envs=false"]
    sys.argv += ["--eval.n_episodes=4", "--eval.batch_size=2", f"--output_dir={folder}"]
    lerobot_train.main()
    return found_in(folder)


def found_in(folder: Path) -> dict[str, Any]:
    def hashes(pattern: str) -> dict[str, str]:
        return {
            str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(folder.rglob(pattern))
            if not path.is_symlink() and "last" not in path.parts
        }

    keys = ("avg_sum_reward", "avg_max_reward", "pc_success", "n_episodes")
    return {
        "evaluations": [{key: one["overall"].get(key) for key in keys} for one in TOLD],
        "videos": hashes("*.mp4"),
        "weights": hashes("model.safetensors"),
    }


def listened() -> None:
    """Have the results of its evaluations kept: it only logs them."""
    evaluate = lerobot_train.eval_policy_all

    def kept(*args: Any, **kwargs: Any) -> Any:
        result = evaluate(*args, **kwargs)
        TOLD.append({"overall": dict(result["overall"])})
        return result

    lerobot_train.eval_policy_all = kept


if __name__ == "__main__":
    file, *page = sys.argv[1:]
    if not hasattr(EnvConfig, "create_envs"):
        print(json.dumps({"asks configs": False}))
        sys.exit()
    recorded(Path("recorded"))
    listened()
    own = ("--dataset.repo_id=robots/recorded", "--policy.push_to_hub=false")
    here = trained("here", "--env.type=of_this_process", f"--env.file={file}", *own)
    executed = os.environ.pop("REACHED", None) is not None
    sandboxed = trained("sandboxed", *page)
    saved = Path("sandboxed/checkpoints/last/pretrained_model/train_config.json")
    report = {
        "asks configs": True,
        "here": here,
        "executed by LeRobot": executed,
        "sandboxed": sandboxed,
        "saved": json.loads(saved.read_text())["env"]["repo"],
    }
    TOLD.clear()
    sys.argv = ["lerobot-train", PLUGIN, f"--config_path={saved}", "--resume=true", "--steps=6"]
    lerobot_train.main()
    report["resumed"] = found_in(Path("sandboxed"))
    report["executed here"] = "REACHED" in os.environ
    print(json.dumps(report))
