"""``envhub replay`` of what came from a Hub or from somebody: a pin runs, and the user decides."""

import json
import shutil
from pathlib import Path

import pytest

from envhub_sandbox import errors, make_env
from envhub_sandbox.system.folders import cache_root
from tests.hub.olah_server import OlahServer
from tests.support.command_line import envhub
from tests.support.output.bundles import crashed
from tests.support.repositories import STILL, write_repository
from tests.support.samples import sample


def test_the_pinned_commit_runs_again(
    olah: OlahServer, hub_cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the branch has become; the Hub is named by the user, or not at all."""
    code = (sample("faulty") / "env.py").read_text()
    repository = olah.repository("org/cli-replays", "model")
    commit = repository.commit({"env.py": code})
    place = {"endpoint": olah.endpoint, "hub_cache_dir": hub_cache}
    bundle = crashed(tmp_path / "crashes", "org/cli-replays@main", **place)
    repository.commit({"env.py": code.replace("os._exit(7)", "os._exit(8)")})
    refused = envhub("replay", bundle, code=2)
    assert "endpoint=" in refused.stderr
    assert "--grant" in refused.stderr
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    done = envhub("replay", bundle, "--grant", code=0)
    assert f"org/cli-replays@{commit[:12]}" in done.stdout
    assert done.stdout.count("request 4, step 3: exit (exit code 7)\n") == 2


def test_only_the_callers_own_bundle_needs_no_grant(tmp_path: Path) -> None:
    """Somebody else's opens no network, folder or repository of the caller's, unless he grants it.
    What this program has written, where it writes bundles, is his own."""
    bundle = crashed(tmp_path, sample("faulty"), policy={"network": "loopback"})
    refused = envhub("replay", bundle, code=2)
    assert "network='loopback'" in refused.stderr
    assert f"repository='{sample('faulty')}" in refused.stderr
    assert envhub("replay", bundle, "--grant").returncode == 0
    ours = cache_root() / "crashes" / "ours"
    shutil.copytree(bundle, ours)
    ours.parent.chmod(0o700)
    assert envhub("replay", ours).returncode == 0


def test_what_cannot_be_replayed_is_refused(tmp_path: Path) -> None:
    """Not in this process, not from anywhere, and not with a task that is no more."""
    bundle = crashed(tmp_path, sample("faulty"))
    assert envhub("replay", bundle, "--sandbox", "none").returncode == 2
    assert envhub("replay", tmp_path).returncode == 2
    file = bundle / "bundle.json"
    document = json.loads(file.read_text())
    document["task"]["suite"] = "\x1b[31mother"
    file.write_text(json.dumps(document))
    refused = envhub("replay", bundle, "--grant", code=2)
    assert "so nothing can be repeated" in refused.stderr
    assert "\x1b" not in refused.stderr


_FUSE = f"""{STILL}
import os

class Fuse(Still):
    def __init__(self, length):
        self.left = length
    def step(self, action):
        self.left -= 1
        if not self.left:
            os._exit(3)
        return super().step(action)

def make_env(n_envs=1, use_async_envs=False, cfg=None, tasks=("a", "b")):
    kind = lambda: Fuse(cfg.lengths["long"][1])
    return {{"fuses": {{task: vector(kind, n_envs) for task in tasks}}}}
"""


class Config:
    """As LeRobot's: the fields are the repository's business."""

    def __init__(self, hub_path: Path) -> None:
        self.hub_path = str(hub_path)
        self.lengths = {"long": (1, 5)}


def test_a_config_and_a_task_are_found_again(tmp_path: Path) -> None:
    """``cfg`` is made again out of plain values; of a suite the task that died is repeated."""
    config = Config(write_repository(tmp_path / "fuse", _FUSE))
    policy = {"crash_folder": str(tmp_path / "crashes")}
    with make_env(config, env_kwargs={"tasks": ["x", "y"]}, policy=policy) as suites:
        env = suites["fuses"]["y"]
        env.reset(seed=1)
        with pytest.raises(errors.WorkerDiedError) as caught:
            _ = [env.step([0]) for _ in range(10)]
    done = envhub("replay", str(caught.value.bundle), "--grant", "--json", code=0)
    document = json.loads(done.stdout)
    assert document["replayed"]["steps"] == 5
