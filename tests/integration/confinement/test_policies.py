"""What a policy grants reaches the repository, or is refused with what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import PolicyError, SandboxUnavailableError
from envhub_worker.lockdown.gpus import gpu_devices
from envhub_worker.lockdown.root_plan import real_host
from tests.support.repositories import STILL, write_repository


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A repository that looks at its home."""
    return write_repository(tmp_path, f"import os\nprint(os.environ['HOME'])\n{STILL}")


@pytest.mark.parametrize("name", ["HOME", "TMPDIR"])
def test_a_granted_home_does_not_break_loading(
    folder: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The variable has the caller's value; what we write lies in a folder of the jail's own."""
    monkeypatch.setenv(name, "/nowhere/at/all")
    env = make_env(folder, policy={"environment": (name,)}).env
    env.reset(seed=1)
    env.close()


def test_a_path_that_is_not_there_is_refused(folder: Path) -> None:
    """Before anything is started; one that is there is not."""
    missing = str(folder / "missing")
    with pytest.raises(PolicyError, match="there is no such file or folder"):
        make_env(folder, policy={"readable": (missing,)})
    make_env(folder, policy={"readable": (str(folder),)}).close()


def test_a_gpu_that_is_not_there_is_told(folder: Path) -> None:
    """With what to do; where there is one it is handed in."""
    make_env(folder).close()  # the control
    if gpu_devices(real_host()):
        with make_env(folder, policy={"gpu": True}) as suites:
            suites.env.reset(seed=1)
        return
    with pytest.raises(SandboxUnavailableError, match=r"there is none here.*\n.*grant no GPU"):
        make_env(folder, policy={"gpu": True})
