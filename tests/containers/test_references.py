"""In a container, too: assets, and environments that a package registers."""

from pathlib import Path

import pytest

from tests.hub.stub_hub import StubHub, StubRepository
from tests.support.repositories import STILL
from tests.support.started import started

READS = f"""{STILL}
import os
from pathlib import Path

class Reads(Still):
    def mesh(self):
        [found] = Path(os.environ["HF_HOME"]).glob("hub/datasets--org--data/snapshots/*/mesh.txt")
        return found

    def text(self):
        return self.mesh().read_text()

    def write(self):
        self.mesh().write_text("changed")
"""


def test_assets_are_mounted_read_only(docker: object, stub_hub: StubHub, hub_cache: Path) -> None:
    """They lie in the jail's cache of the Hub, and stay as they were verified."""
    stub_hub.add("org/data", {"mesh.txt": "a mesh"}, "dataset")
    stub_hub.add("org/repo", {"env.py": READS})
    commit = StubRepository({}).commit
    given = {"endpoint": stub_hub.endpoint, "hub_cache_dir": hub_cache, "token": False}
    assets = [f"datasets/org/data@{commit}"]
    with started(f"org/repo@{commit}", sandbox=docker, assets=assets, **given) as env:
        assert env.call("text") == ("a mesh",)
        with pytest.raises(OSError, match=r"Read-only|Permission"):
            env.call("write")


def test_an_environment_that_gymnasium_registers(docker: object) -> None:
    """Without a repository: the file that stands for it runs where each repository's does."""
    with started("pypi:gymnasium#CartPole-v1", n_envs=2, sandbox=docker) as env:
        observations, *_ = env.step(env.action_space.sample())
        assert observations.shape == (2, 4)
