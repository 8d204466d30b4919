"""What a host can enforce is found out by doing, and what is missing is told with its fix."""

from __future__ import annotations

import json
import os
import sys
from typing import Any

from envhub_worker import bootstrap
from tests.support.command_line import python

FORBID = """
import sys
from envhub_worker.lockdown.mechanisms import namespaces
import os
namespaces.enter_user_namespace(os.getuid(), os.getgid())
namespaces.forbid_what_is_counted()
os.execv(sys.executable, {command!r})
"""


def probe(*arguments: str) -> dict[str, Any]:
    """The JSON that the program prints."""
    return dict(json.loads(python(*arguments).stdout))


def test_this_host_can_enforce_every_layer() -> None:
    """As root and as a plain user; control groups as root only."""
    found = probe(*bootstrap.command(sys.executable, "probe")[1:])
    available = {entry["layer"]: entry["available"] for entry in found["layers"]}
    assert set(available) == {
        "unprivileged-user",
        "user-namespace",
        "namespaces",
        "mount-namespace",
        "copy-on-write",
        "capabilities",
        "landlock",
        "seccomp",
        "cgroup",
    }
    available.pop("cgroup")
    assert all(available.values()), found
    assert found["host"]["landlock_abi"] >= 1
    assert found["host"]["user"] == ("root" if os.geteuid() == 0 else "plain user")


def test_all_missing_layers_are_told_with_a_fix() -> None:
    """A jail would stop at the first."""
    found = probe("-c", FORBID.format(command=bootstrap.command(sys.executable, "probe")))
    missing = {entry["layer"]: entry for entry in found["layers"] if not entry["available"]}
    assert {"user-namespace", "namespaces", "mount-namespace"} <= set(missing)
    assert missing["user-namespace"]["detail"] == "user.max_user_namespaces is 0"
    assert "sudo sysctl user.max_user_namespaces" in missing["user-namespace"]["fix"]
    assert "landlock" not in missing
    assert "seccomp" not in missing
