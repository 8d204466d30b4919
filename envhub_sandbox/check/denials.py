"""What a jail was denied, by the word of its first process: attempts that say something.

The system call filter asks that process, so that nothing is the repository's word. Files are not
among it: in a private root what may not be read does not exist, and the kernel tells nobody.
"""

from __future__ import annotations

from collections.abc import Iterable

_NETWORK = "socket AF_"
_LOCAL = frozenset({"socket AF_UNIX", "socketpair AF_UNIX"})
_HARMLESS = frozenset(
    {
        *("mbind", "set_mempolicy", "set_mempolicy_home_node", "migrate_pages", "move_pages"),
        *("setpriority", "ioprio_set", "io_uring_setup", "socket AF_NETLINK"),
    }
)
"""What allocators, pools of threads and the C library try on their way, and do without."""


def sorted_out(denied: Iterable[str]) -> dict[str, list[str]]:
    """The findings of each check, of what was denied."""
    found: dict[str, list[str]] = {"denied-network": [], "denied-kernel": []}
    for one in sorted(set(denied) - _HARMLESS):
        is_network = one.startswith(_NETWORK) and one not in _LOCAL
        text = f"tried {one}, and was refused"
        found["denied-network" if is_network else "denied-kernel"].append(text)
    return found
