"""What confined a repository while it was judged, and what did not, for every form of a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from envhub_worker.protocol.text import printable

_MOST, _LONGEST = 40, 300
_WHOLE = "strict"


@dataclass(frozen=True, kw_only=True)
class Confinement:
    """The confinement of one judgement.

    Attributes:
        asked: The profile that the caller named, or the default: no other is taken for it.
        profile: The one that its jails had; empty where it did not load.
        missing: Layers that did not hold, by name, and why.
        unrecorded: Why what it tried was not recorded; empty where it was.
    """

    asked: str
    profile: str
    missing: tuple[tuple[str, str], ...]
    unrecorded: str

    @classmethod
    def of(cls, asked: str, provenance: Mapping[str, Any] | None, unrecorded: str) -> Confinement:
        """Of what ran. Trust: a server on another host may have said which layers hold."""
        ran = provenance or {}
        layers = ran.get("layers") or ()
        missing = [one for one in layers if one.get("enforced") is not True][:_MOST]
        return cls(
            asked=asked,
            profile=ran.get("profile") or "",
            missing=tuple((_line(one.get("layer")), _line(one.get("detail"))) for one in missing),
            unrecorded=_line(unrecorded),
        )

    @property
    def is_partial(self) -> bool:
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


def _line(text: object) -> str:
    return " ".join(printable(str(text), _LONGEST).split())
