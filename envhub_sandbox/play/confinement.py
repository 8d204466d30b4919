"""Reports what confined a repository while it was checked, and what it was denied.

Denials come from the jail's first process, which the system call filter asks, not from the
repository. But the repository may change a path in its memory while the first process reads it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from envhub_worker.protocol.text import counted, printable

_MOST, _LONGEST = 40, 300
_WHOLE = "strict"
_OF_ALL_PLAIN_USERS = "user-quotas"
"""A layer that no user without root can have; ``envhub doctor`` says so, not each run."""
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


@dataclass(frozen=True, kw_only=True)
class Confinement:
    """The confinement during one check.

    Attributes:
        asked: The profile that the caller named, or the default one.
        profile: The profile of the jails; empty if the repository did not load.
        held: The number of layers that were enforced.
        missing: The layers that were not enforced, by name, and why.
        unrecorded: Why denials were not recorded; empty if they were.
    """

    asked: str
    profile: str
    missing: tuple[tuple[str, str], ...]
    unrecorded: str
    held: int = 0

    @classmethod
    def of(cls, asked: str, provenance: Mapping[str, Any] | None, unrecorded: str) -> Confinement:
        """Read a provenance. Trust: a server on another host may claim any layers."""
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
        """Whether to tell people that the confinement or its record was not complete."""
        return (self.profile or self.asked) != _WHOLE or bool(self.unrecorded)

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield pairs of title and text, as ``envhub run`` prints them."""
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
        """Yield the rows as lines of text."""
        yield from (f"{title}: {text}" for title, text in self.rows())

    def document(self) -> dict[str, Any]:
        """The confinement as plain data."""
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
