"""What of a jail's denials is worth a finding."""

from __future__ import annotations

import pytest

from envhub_sandbox.check.play.confinement import denial_findings


@pytest.mark.parametrize(
    ("denied", "network", "files", "kernel", "limits"),
    [
        ((), 0, 0, 0, 0),
        (("setpriority", "mbind", "socket AF_NETLINK"), 0, 0, 0, 0),
        (("socket AF_INET", "socket AF_NETLINK_OTHER", "socket AF_PACKET"), 3, 0, 0, 0),
        (("socket AF_UNIX", "ptrace", "mount"), 0, 0, 3, 0),
        (("setpriority OTHER_PROCESS", "kill OTHER_PROCESS"), 0, 0, 2, 0),
        (("ptrace", "ptrace"), 0, 0, 1, 0),
        (("read /etc/shadow", "unlink /socket AF_INET", "sendto /run/x"), 0, 3, 0, 0),
        (("limit PROCESSES", "limit DISK_BYTES"), 0, 0, 0, 2),
        (("unlink /a OTHER_PROCESS", "read /limit PROCESSES"), 0, 2, 0, 0),
    ],
    ids=["nothing", "harmless", "network", "kernel", "others", "once", "files", "limits", "names"],
)
def test_attempts_are_sorted(
    denied: tuple[str, ...], network: int, files: int, kernel: int, limits: int
) -> None:
    found = denial_findings(denied)
    assert {check: len(texts) for check, texts in found.items()} == {
        "denied-network": network,
        "denied-files": files,
        "denied-kernel": kernel,
        "limits-reached": limits,
    }
