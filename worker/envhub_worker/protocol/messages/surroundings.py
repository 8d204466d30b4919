"""What a server in a container announces of its surroundings: the one message that is no frame.

It is a line of JSON on stdout, before the first request is read. The worker fills it in
(``lockdown/surroundings.py``), the client holds it against what it asked the engine for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from envhub_worker.protocol.confinement import PROFILES
from envhub_worker.protocol.records import dataclass

_MAX_NAME = 64


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """What holds around a process.

    Attributes:
        profiles: Those of a jail that can be had in there, the strongest first.
        landlock: Its ABI, or 0.
        user: The process's id.
        capabilities: What some set holds, as a number.
        no_new_privileges: Whether it can gain none.
        seccomp: Whether a filter is there.
        read_only: Whether the root is.
        devices: Names of network devices.
        memory: Its limit in bytes, or None.
        pids: The limit of processes and threads, or None.
        cpus: The limit in processors' worth of time, or None.
        python: The interpreter for jails; empty for the server's own.
    """

    profiles: tuple[str, ...]
    landlock: int
    user: int
    capabilities: int
    no_new_privileges: bool
    seccomp: bool
    read_only: bool
    devices: tuple[str, ...]
    memory: int | None
    pids: int | None
    cpus: float | None
    python: str

    @classmethod
    def read(cls, said: Mapping[str, Any]) -> Surroundings:
        """What was announced, each field as its type. Raises whatever the values lead to.

        Unknown profiles are left out. Trust: input from the worker.
        """
        fields = {name: _READERS[kind](said[name]) for name, kind in cls.__annotations__.items()}
        known = tuple(name for name in fields.pop("profiles") if name in PROFILES)
        return cls(profiles=known, **fields)


_READERS: dict[str, Callable[[Any], Any]] = {
    "bool": lambda said: said is True,
    "int": int,
    "int | None": lambda said: None if said is None else int(said),
    "float | None": lambda said: None if said is None else float(said),
    "str": str,
    "tuple[str, ...]": lambda said: tuple(str(name)[:_MAX_NAME] for name in said),
}
"""By the annotation of a field, as it is written above."""
