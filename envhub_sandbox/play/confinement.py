"""Reports what confined a repository while it ran."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from envhub_worker.protocol.text import counted, printable

_MOST, _LONGEST = 40, 300
_WHOLE = "strict"
_OF_ALL_PLAIN_USERS = "user-quotas"
"""A layer that no user without root can have; ``envhub doctor`` says so, not each run."""


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
