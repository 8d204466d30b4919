"""A repository on a node of a cluster: from its jail it reaches nothing of Ray.
Whoever reaches a Ray cluster runs code on all of it, so an actor that is there afterwards is the
whole of the damage. Each attack succeeds in the same run where nothing confines it."""

import os
import secrets
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import RaySandbox, make_env
from envhub_sandbox.errors import EnvHubError
from tests.support.processes import eventually
from tests.support.repositories import write_repository

ray = pytest.importorskip("ray")
ENV = """
import os
import sys
import gymnasium as gym

ADDRESS, FOLDER = {address!r}, {folder!r}

class Attack(gym.Env):
    observation_space = action_space = gym.spaces.Discrete(2)

    def take_over(self, name):
        import ray
        ray.init(address=ADDRESS, namespace="attack", log_to_driver=False)
        made = ray.remote(Owned).options(name=name, lifetime="detached", num_cpus=0).remote()
        return ray.get(made.answer.remote())

    def steal(self):
        found = [repr(sorted(os.environ.items()))]
        for folder, _, names in os.walk(FOLDER):
            for name in names:
                try:
                    with open(os.path.join(folder, name), "rb") as file:
                        found.append(repr(file.read(1000)))
                except OSError:
                    pass
        return " ".join(one for one in found if "secret-" in one)[:10_000]

class Owned:
    def answer(self):
        return "owned"

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Attack])

if __name__ == "__main__":
    print(getattr(Attack(), sys.argv[1])(*sys.argv[2:]))
"""


@pytest.fixture
def repository(tmp_path: Path, cluster: Any) -> Path:
    folder = cluster.head_node.get_temp_dir_path()
    return write_repository(tmp_path / "repo", ENV.format(address=cluster.address, folder=folder))


def unconfined(repository: Path, *words: str, **variables: str) -> str:
    """What the same code says where nothing confines it."""
    command = [sys.executable, str(repository / "env.py"), *words]
    environment = {**os.environ, **variables}
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def was_made(name: str) -> bool:
    """Whether there is an actor of that name, as the cluster says."""
    found = ray.util.list_named_actors(all_namespaces=True)
    return name in {one["name"] for one in found}


def test_a_jail_starts_nothing_in_the_cluster(repository: Path) -> None:
    """By Ray's own client, at the address that it is given; the process may die of the attempt."""
    with make_env(repository, sandbox="ray", timeouts={"call_s": 30}) as suites:
        env = suites.env
        with pytest.raises(EnvHubError):
            env.call("take_over", "inside")
    assert "owned" in unconfined(repository, "take_over", "outside")
    assert eventually(lambda: was_made("outside"))
    assert not was_made("inside")
    ray.kill(ray.get_actor("outside", namespace="attack"))


@pytest.mark.short
def test_a_jail_reads_nothing_of_rays(repository: Path, cluster: Any) -> None:
    """Neither its token, which is in the environment of a node's processes, nor its folder."""
    token = f"secret-{secrets.token_hex(8)}"
    kept = Path(cluster.head_node.get_session_dir_path(), token)
    kept.write_text(token)
    place = RaySandbox(runtime_env={"env_vars": {"RAY_AUTH_TOKEN": token}})
    with make_env(repository, sandbox=place) as suites:
        assert suites.env.call("steal") == ("",)
    assert token in unconfined(repository, "steal")
    kept.unlink()
    assert token in unconfined(repository, "steal", RAY_AUTH_TOKEN=token)
