"""What a jail was denied, by the word of its first process: attempts that say something.

The system call filter asks that process, so that nothing is the repository's word; but a path is
read out of the memory of the process that asks, which may change it meanwhile.
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
"""What allocators, pools of threads and the C library try on their way, and do without."""


def denial_findings(denied: Iterable[str]) -> dict[str, list[str]]:
    """The findings of each check, of what was denied. Trust: paths are a stranger's words."""
    checks = ("denied-network", "denied-files", "denied-kernel", "limits-reached")
    found: dict[str, list[str]] = {check: [] for check in checks}
    for one in sorted(set(denied) - _HARMLESS):
        check, text = _finding(one)
        found[check].append(text)
    return found


def _finding(one: str) -> tuple[str, str]:
    deed, _, path = one.partition(" ")
    if path.startswith("/"):
        return "denied-files", f"asked to {_DEEDS.get(deed, deed)} {path}, which is not its own"
    if deed == "limit":
        return "limits-reached", f"used up what limits permit of {path.lower()}"
    if one.endswith(_OTHER):
        return "denied-kernel", f"tried {deed} of a process that is not its own"
    is_network = one.startswith(_NETWORK) and one not in _LOCAL
    return "denied-network" if is_network else "denied-kernel", f"tried {one}, and was refused"
