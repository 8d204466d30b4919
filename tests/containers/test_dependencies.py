"""A repository's packages, made here and mounted into its container."""

from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.extras.docker import packages
from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.extras.docker.sandbox import DockerSandbox
from envhub_sandbox.extras.packages import environments, interpreters
from tests.containers.kit import IMAGE
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import Index, make_wheel
from tests.support.repositories import write_repository

ENV = """
import os
import gymnasium as gym
import wanted

class Told(gym.Wrapper):
    def version(self):
        return wanted.VERSION
    def spoiled(self):
        try:
            open(os.path.join(os.path.dirname(wanted.__file__), "spoiled"), "w").close()
        except OSError:
            return False
        return True

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([lambda: Told(gym.make("CartPole-v1"))] * n_envs)
"""


@pytest.fixture
def fits(engine: Engine) -> None:
    """An image whose Python this machine has, with a glibc that is no older."""
    theirs, _ = packages.image_packages(engine, IMAGE)
    ours = interpreters.own()
    same = ours.version.split(".")[:2] == theirs.version.split(".")[:2]
    if not same or ours.machine != theirs.machine:
        pytest.skip("needs an image of this interpreter's kind")


@pytest.mark.usefixtures("fits")
def test_packages_are_mounted_and_stay_as_they_are(
    engine: Engine, docker: DockerSandbox, real_index: Index, tmp_path: Path
) -> None:
    """What the image lacks is made here; what a jail writes there only itself sees."""
    make_wheel(real_index.folder, "wanted", "1.0")
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt="wanted==1.0\n")
    with make_env(folder, sandbox=docker) as suites:
        suites.env.reset(seed=0)
        assert suites.env.call("version") == ("1.0",)
        assert "wanted==1.0" in suites.provenance["installed"]["packages"]
        [made] = environments.every()
        (made.packages / "wanted").chmod(0o777)
        writable = f"type=bind,src={made.packages},dst=/packages"
        words = ("--mount", writable, "--entrypoint", "touch", IMAGE, "/packages/wanted/control")
        engine.run("run", "--rm", "--network", "none", *words)
        assert (made.packages / "wanted/control").exists()  # so somebody could
        assert suites.env.call("spoiled") == (True,)
    assert not (made.packages / "wanted/spoiled").exists()
    with refused_dependency("module", match="envhub image build"):
        make_env(folder, sandbox=docker, dependencies="host")


@pytest.mark.usefixtures("fits")
def test_what_the_image_has_is_not_made_again(
    docker: DockerSandbox, real_index: Index, tmp_path: Path
) -> None:
    folder = write_repository(tmp_path / "repo", ENV.replace("import wanted\n", ""))
    (folder / "requirements.txt").write_text("gymnasium>=0.29\nmsgpack\n")
    asked = len(real_index.asked)
    with make_env(folder, sandbox=docker) as suites:
        suites.env.reset(seed=0)
        assert suites.provenance["installed"] is None
    assert len(real_index.asked) == asked
