"""What a runner tries before a stranger's code: where nothing confines, all of it goes through."""

import json
import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from envhub_worker.lockdown import probe
from envhub_worker.lockdown.mechanisms import kernel, namespaces
from tests.support import inside

CLAIMS = [
    "no capability is left",
    "no_new_privs is set",
    "a system call filter is installed",
    "what is written to {}/packages stays in the jail",
    "only named descriptors are open",
    "no user namespace can be made",
    "nothing can be mounted",
    "init cannot be traced",
    "init's limits cannot be changed",
    "the snapshot cannot be written",
    "{}/snapshot cannot be written",
    "files outside cannot be read",
    "init cannot be signalled",
    "no internet socket can be made",
]


def test_every_claim_is_false_where_nothing_confines(tmp_path: Path) -> None:
    """In namespaces of its own, so that no attempt does harm; as who may do everything there."""
    tried = probe.try_layer("self-test", partial(_found_untrue, tmp_path))
    assert json.loads(tried["detail"]) == [claim.format(tmp_path) for claim in CLAIMS]


def _found_untrue(folder: Path) -> str:
    namespaces.enter_user_namespace(os.getuid(), os.getgid())
    kernel.unshare(kernel.CLONE_NEWNS)
    kernel.mount("none", "/", "none", kernel.MS_REC | kernel.MS_PRIVATE)
    kernel.mount("none", str(folder), "tmpfs")  # of whose files some have no name
    for name in ("snapshot", "packages"):
        (folder / name).mkdir()
    (folder / "snapshot" / "env.py").touch()
    found: list[str] = []
    init = os.fork()
    if init == 0:
        signal.pause()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "getppid", lambda: init)
        patch.setattr(*inside.DENIED, _denied_in_a_child)
        patch.setattr(*inside.HOLD, lambda claim, holds: found.extend([claim] * (not holds)))
        inside.self_test(_jail(folder), ())
    os.kill(init, signal.SIGKILL)
    return json.dumps(found)


def _denied_in_a_child(attempt: Callable[[], object]) -> bool:
    """One attempt does not change what the next one may."""
    pid = os.fork()
    if pid == 0:
        kernel.unshare(kernel.CLONE_NEWNS)
        try:
            attempt()
        except OSError:
            os._exit(1)
        os._exit(0)
    return os.waitpid(pid, 0)[1] != 0


def _jail(folder: Path) -> Any:
    snapshot, packages = str(folder / "snapshot"), str(folder / "packages")
    config = SimpleNamespace(canary=__file__, network="none")
    return SimpleNamespace(
        spec=SimpleNamespace(snapshot=snapshot, entry="env.py"),
        view=SimpleNamespace(
            shared={packages: os.open(packages, os.O_PATH)}, refused={snapshot: ""}
        ),
        common=SimpleNamespace(landlock_abi=7, namespaced=True, brokered=False, config=config),
    )
