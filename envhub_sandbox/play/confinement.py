"""What confined a repository while it was judged, and what it was denied.

Denials come from the jail's first process, which the system call filter asks, and not from the
repository; but it may change a path in its memory while that is read.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from envhub_worker.protocol.text import counted, printable

_MOST, _LONGEST = 40, 300
_WHOLE = "strict"
_OF_ALL_PLAIN_USERS = "user-quotas"
"""A layer that none of them can have: ``envhub doctor`` says so once, and not each run."""
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


@dataclass(frozen=True, kw_only=True)
class Confinement:
    """The confinement of one judgement.

    Attributes:
        asked: The profile that the caller named, or the default: no other is taken for it.
        profile: The one that its jails had; empty where it did not load.
        held: How many layers held.
        missing: Layers that did not hold, by name, and why.
        unrecorded: Why what it tried was not recorded; empty where it was.
    """

    asked: str
    profile: str
    missing: tuple[tuple[str, str], ...]
    unrecorded: str
    held: int = 0

    @classmethod
    def of(cls, asked: str, provenance: Mapping[str, Any] | None, unrecorded: str) -> Confinement:
        """Of what ran. Trust: a server on another host may have said which layers hold."""
        ran = provenance or {}
        layers = ran.get("layers") or ()
        lacks = [layer for layer in layers if layer.get("enforced") is not True][:_MOST]
        return cls(
            asked=asked,
            profile=ran.get("profile") or "",
            missing=tuple(
                (_line(layer.get("layer")), _line(layer.get("detail"))) for layer in lacks
            ),
            unrecorded=_line(unrecorded),
            held=sum(layer.get("enforced") is True for layer in layers),
        )

    @property
    def is_partial(self) -> bool:
        """Whether a person should know that there was less than there can be."""
        return (self.profile or self.asked) != _WHOLE or bool(self.unrecorded)

    def rows(self) -> Iterator[tuple[str, str]]:
        """In the words of ``envhub run``: what is said, and about what."""
        if not self.profile:
            yield "confined by", f"{self.asked}; it did not load"
        else:
            layers = f"{self.profile}, {counted(self.held, 'layer')}"
            other = f", in a container; {self.asked} was asked for"
            yield "confined by", layers + other * (self.profile != self.asked)
        for layer, why in self.missing:
            if layer != _OF_ALL_PLAIN_USERS:
                yield "not enforced", f"{layer}: {why}"
        if self.unrecorded:
            yield "not recorded", f"denied attempts: {self.unrecorded}"

    def lines(self) -> Iterator[str]:
        """The same, one line each."""
        yield from (f"{title}: {text}" for title, text in self.rows())

    def document(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "asked": self.asked,
            "profile": self.profile or None,
            "missing": [{"layer": layer, "why": why} for layer, why in self.missing],
            "recorded": not self.unrecorded,
            "why_not_recorded": self.unrecorded or None,
        }


def _line(text: object) -> str:
    return " ".join(printable(str(text), _LONGEST).split())


def denial_findings(denied: Iterable[str]) -> dict[str, list[str]]:
    """The findings of each check, of what was denied. Trust: paths are a stranger's words."""
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
