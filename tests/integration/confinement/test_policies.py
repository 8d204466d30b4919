"""What a policy grants reaches the repository, or is refused with what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from envhub_sandbox import make_env
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
