"""What one jail is made for: a snapshot, its entry file and what it is permitted."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from envhub_worker.protocol.confinement import Confinement, Limits


@dataclass(frozen=True, kw_only=True)
class JailSpec:
    """One jail.

    Attributes:
        snapshot: Absolute path of the read-only snapshot root.
        entry: The entry file, relative to it.
        confinement: What the jail is permitted.
        name: For logs.
    """

    snapshot: str
    entry: str
    confinement: Confinement
    name: str

    def to_wire(self) -> dict[str, Any]:
        """Plain data for a channel between our own processes."""
        return asdict(self)

    @classmethod
    def from_wire(cls, data: dict[str, Any]) -> JailSpec:
        """The inverse of ``to_wire``."""
        return cls(**{**data, "confinement": confinement_from_wire(data["confinement"])})


def confinement_from_wire(data: dict[str, Any]) -> Confinement:
    """A ``Confinement`` from its ``dataclasses.asdict`` form, lists for tuples permitted."""
    return Confinement(
        **{**data, "readable": tuple(data["readable"]), "limits": Limits(**data["limits"])}
    )
