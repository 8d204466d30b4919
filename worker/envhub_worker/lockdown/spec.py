"""The specification of one jail: a snapshot, its entry file and its permissions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from envhub_worker.protocol.confinement import DISPLAYS, NETWORKS, PROFILES, Confinement, Limits
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.runtime import HubCopy, read_hub_copies
from envhub_worker.protocol.start_variables import why_not

_MAX_LIMIT = 1 << 62
_MAX_OUTPUT_BYTES = 64 << 20
"""The server itself keeps what a jail prints."""
_MAX_ENVIRONMENT_BYTES = 64 << 10
"""All granted variables together: they travel in one packet between our own processes."""
_MAX_READABLE = 64
_MAX_GPUS = 64
_LIFTABLE = frozenset({"cpu_time_s", "file_bytes"})


@dataclass(frozen=True, kw_only=True)
class JailSpec:
    """One jail.

    Attributes:
        snapshot: Absolute path of the read-only snapshot root.
        entry: The entry file, relative to the snapshot.
        hub_copies: The repositories in the jail's Hub cache.
    """

    snapshot: str
    entry: str
    confinement: Confinement
    hub_copies: tuple[HubCopy, ...] = ()

    @classmethod
    def from_wire(cls, data: dict[str, Any]) -> JailSpec:
        """Rebuilds a specification from its ``dataclasses.asdict`` form after JSON."""
        copies = read_hub_copies(data["hub_copies"])
        confinement = confinement_from_wire(data["confinement"])
        return cls(**{**data, "confinement": confinement, "hub_copies": copies})


def confinement_from_wire(data: dict[str, Any]) -> Confinement:
    """Reads a ``Confinement`` from its ``dataclasses.asdict`` form; lists may stand for tuples.

    Trust: a client on another host may have written it.
    Raises ``RemoteProtocolError``: a name, a type or a number is invalid.
    """
    names = {item.name for item in fields(Confinement)}
    if set(data) != names:
        raise RemoteProtocolError("the confinement lacks a field, or has an unknown one")
    readable = data["readable"]
    if type(readable) not in (list, tuple) or not all(type(path) is str for path in readable):
        raise RemoteProtocolError("the readable paths are not a list of strings")
    checked = {"limits": _limits(data["limits"]), "gpu": _gpu(data["gpu"])}
    confinement = Confinement(**{**data, "readable": tuple(readable), **checked})
    if (
        confinement.profile in PROFILES
        and confinement.network in NETWORKS
        and confinement.display in DISPLAYS
        and type(confinement.record_denials) is bool
        and len(readable) <= _MAX_READABLE
        and _may_be_granted(confinement.environment)
    ):
        return confinement
    raise RemoteProtocolError("a field of the confinement has an invalid value")


def _gpu(value: Any) -> bool | tuple[int, ...]:
    if type(value) is bool:
        return value
    whole = type(value) in (list, tuple) and all(type(index) is int for index in value)
    if not whole or not 0 < len(value) <= _MAX_GPUS or min(value) < 0:
        raise RemoteProtocolError("gpu is neither a boolean nor a list of indices")
    return tuple(value)


def _limits(data: Any) -> Limits:
    names = {item.name for item in fields(Limits)}
    if not isinstance(data, Mapping) or not set(data) <= names:
        raise RemoteProtocolError("the limits have an unknown field")
    for name, value in data.items():
        highest = _MAX_OUTPUT_BYTES if name == "output_bytes" else _MAX_LIMIT
        lifted = value is None and name in _LIFTABLE
        if not lifted and not (type(value) is int and 1 <= value <= highest):
            raise RemoteProtocolError(f"the limit {name} is not a whole number from 1 to {highest}")
    return Limits(**data)


def _may_be_granted(environment: Any) -> bool:
    if type(environment) is not dict:
        return False
    texts = [*environment, *environment.values()]
    if not all(type(text) is str and "\0" not in text for text in texts):
        return False
    if any(why_not(name, value) for name, value in environment.items()):
        return False
    return sum(map(len, texts)) <= _MAX_ENVIRONMENT_BYTES
