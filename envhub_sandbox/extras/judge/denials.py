"""Findings from what a repository was denied.

Denials come from the jail's first process, which the system call filter asks, not from the
repository. But the repository may change a path in its memory while the first process reads it.
"""

from __future__ import annotations

from collections.abc import Iterable

_NETWORK = "socket AF_"
_LOCAL = frozenset({"socket AF_UNIX", "socketpair AF_UNIX"})
_DEEDS = {"connect": "connect to", "sendto": "send to"}
_OTHER = " OTHER_PROCESS"
_HARMLESS = frozenset(
    {
        *("mbind", "set_mempolicy", "set_mempolicy_home_node", "migrate_pages", "move_pages"),
        *("setpriority", "ioprio_set", "io_uring_setup", "socket AF_NETLINK"),
    }
)
"""System calls that allocators, thread pools and the C library try, and can do without."""


def denial_findings(denied: Iterable[str]) -> dict[str, list[str]]:
    """Turn denials into findings, by check. Trust: a stranger chose the paths."""
    checks = ("denied-network", "denied-files", "denied-kernel", "limits-reached")
    findings: dict[str, list[str]] = {check: [] for check in checks}
    for denial in sorted(set(denied) - _HARMLESS):
        check, text = _finding(denial)
        findings[check].append(text)
    return findings


def _finding(denial: str) -> tuple[str, str]:
    deed, _, path = denial.partition(" ")
    if path.startswith("/"):
        return (
            "denied-files",
            f"asked to {_DEEDS.get(deed, deed)} {path}, which is outside its own folders",
        )
    if deed == "limit":
        return "limits-reached", f"reached the limit of {path.lower()}"
    if denial.endswith(_OTHER):
        return "denied-kernel", f"tried {deed} on another process"
    is_network = denial.startswith(_NETWORK) and denial not in _LOCAL
    return "denied-network" if is_network else "denied-kernel", f"tried {denial}, which was denied"
