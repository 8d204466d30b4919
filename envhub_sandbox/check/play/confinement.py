"""What confined a repository while it was judged, and what did not, for every form of a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

from envhub_worker.protocol.text import printable

_MOST, _LONGEST = 40, 300
_WHOLE = "strict"


@dataclass(frozen=True, kw_only=True)
class Walls:
    """The confinement of one judgement.

    Attributes:
        asked: The profile that the caller named, or the default: no other is taken for it.
        profile: The one that its jails had; empty where it did not load.
        missing: Layers that did not hold, by name, and why.
        unrecorded: Why what it tried was not recorded; empty where it was.
    """

    asked: str
    profile: str = ""
    missing: tuple[tuple[str, str], ...] = ()
    unrecorded: str = ""

    @property
    def are_fewer(self) -> bool:
        """Whether a person should know that there was less than there can be."""
        return (self.profile or self.asked) != _WHOLE or bool(self.unrecorded)

    def lines(self) -> Iterator[str]:
        """In words, one line each."""
        if not self.profile:
            yield f"profile {self.asked}, as asked for; it did not load"
        elif self.profile == self.asked:
            yield f"profile {self.profile}, as asked for"
        else:
            yield f"profile {self.profile}, within a container; {self.asked} was asked for"
        for layer, why in self.missing:
            yield f"without {layer}: {why}"
        if self.unrecorded:
            yield f"what it tried and was denied is not recorded: {self.unrecorded}"

    def document(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "asked": self.asked,
            "profile": self.profile or None,
            "missing": [{"layer": layer, "why": why} for layer, why in self.missing],
            "recorded": not self.unrecorded,
            "why_not_recorded": self.unrecorded or None,
        }


def walls(asked: str, provenance: Mapping[str, Any] | None, unrecorded: str) -> Walls:
    """Of what ran. Trust: a server on another host may have said which layers hold."""
    told = provenance or {}
    missing = (one for one in told.get("layers") or () if one.get("enforced") is not True)
    return Walls(
        asked=asked,
        profile=told.get("profile") or "",
        missing=tuple(_named(one) for one in islice(missing, _MOST)),
        unrecorded=_line(unrecorded),
    )


def _named(layer: Mapping[str, Any]) -> tuple[str, str]:
    return _line(layer.get("layer")), _line(layer.get("detail"))


def _line(text: object) -> str:
    return " ".join(printable(str(text), _LONGEST).split())
