"""A lock as ``make_env`` uses it: instead of other choices, and against what is there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.dependencies import interpreters, packages
from envhub_sandbox.dependencies.locks import lockfile
from envhub_sandbox.dependencies.locks.lockfile import LockFile, Runner, Spaces
from envhub_sandbox.dependencies.locks.making import fingerprint_of_task
from envhub_sandbox.dependencies.locks.pylock import PylockPackage, Wheel
from envhub_sandbox.errors import LockDriftError, LockError, PolicyError
from envhub_sandbox.hub.snapshot import Snapshot, local
from envhub_worker.protocol.manifest.manifest import Manifest
from tests.support import wire

HERE = Runner.of(interpreters.own())
BOX, ACTIONS = spaces.Box(-1, 1, (3,), np.float32), spaces.Discrete(2)
MANIFEST = Manifest(envs=(wire.env_manifest(BOX, ACTIONS, 2),), lazy=True)


@pytest.fixture
def snapshot(tmp_path: Path, snapshot_store: Path) -> Snapshot:
    (tmp_path / "repo").mkdir()
    (tmp_path / "repo" / "env.py").write_text("1")
    return local(tmp_path / "repo")


def locked(snapshot: Snapshot, **changes: Any) -> LockFile:
    """A lock of it, without a package, changed."""
    fields: dict[str, Any] = {
        "repository": lockfile.LOCAL,
        "commit": snapshot.commit,
        "entry": snapshot.path,
        "files": {file.path: file.digest for file in snapshot.files},
        "runner": HERE,
        "packages": (),
    }
    return LockFile(**(fields | changes))


def test_nothing_else_may_choose_packages(snapshot: Snapshot, tmp_path: Path) -> None:
    """Neither an interpreter, nor dependencies, nor another place; alone it is read."""
    path = tmp_path / "pylock.repo.toml"
    lock = locked(snapshot, packages=(PylockPackage("one", "1.0", (Wheel("a" * 64),)),))
    lockfile.write(lock, path)
    assert packages.opened_lock(path, "process", None, "auto") == lock
    for given in (("process", "3.12", "auto"), ("process", None, "none"), ("process", None, {})):
        with pytest.raises(PolicyError, match="has the packages already"):
            packages.opened_lock(path, *given)
    for place in ("docker", "tcp://host:1", ["process"]):
        with pytest.raises(PolicyError, match="lock is for sandbox='process'"):
            packages.opened_lock(path, place, None, "auto")
    with pytest.raises(LockError):
        packages.opened_lock(tmp_path / "absent.toml", "process", None, "auto")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"files": {"env.py": f"sha256:{'0' * 64}"}}, "env.py: other content"),
        ({"files": {"gone.py": f"sha256:{'0' * 64}"}}, "gone.py: gone"),
        ({"runner": replace(HERE, machine="sparc")}, "on sparc was locked"),
    ],
)
def test_what_has_drifted_gets_no_packages(
    snapshot: Snapshot, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(LockDriftError, match=said) as caught:
        packages.locked_packages(snapshot, locked(snapshot, **changes))
    assert snapshot.label in str(caught.value)


def test_spaces_are_held_against_the_lock_for_the_same_arguments(snapshot: Snapshot) -> None:
    """With others the repository may make others; so it may with ``cfg``."""
    env = MANIFEST.envs[0]
    same = fingerprint_of_task(env.suite, env.task, env.autoreset_mode, BOX, ACTIONS)
    other = fingerprint_of_task(env.suite, env.task, env.autoreset_mode, BOX, spaces.Discrete(3))
    arguments = lockfile.arguments_text({"size": 8})

    def check(task: Any, given: dict[str, Any], config: object = None) -> None:
        lock = locked(snapshot, spaces=Spaces(arguments, (task,)))
        packages.lock_checker(lock, "org/repo", given, config)(MANIFEST)

    check(same, {"size": 8})
    check(other, {"size": 9})
    check(other, {"size": 8}, config={"a": 1})
    with pytest.raises(LockDriftError, match="actions were"):
        check(other, {"size": 8})
    packages.lock_checker(None, "org/repo", {}, None)(MANIFEST)
    packages.lock_checker(locked(snapshot), "org/repo", {}, None)(MANIFEST)
