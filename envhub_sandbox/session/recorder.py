"""Records an environment's requests, to write a crash bundle after a death.

The core's recorder records nothing. The extra ``extras.crash`` has one that writes crash bundles.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from envhub_sandbox.errors import WorkerDiedError, WorkerTimeoutError
from envhub_sandbox.system import extras
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.records import dataclass

if TYPE_CHECKING:
    from envhub_sandbox.transport.jail import Request


@dataclass(frozen=True, kw_only=True)
class Crash:
    """The facts about one death.

    Attributes:
        error: The error that the caller gets.
        load: The arguments of the repository's ``make_env``.
        options: The other arguments that differ from their defaults.
        task: ``suite``, ``task``, ``num_envs``, ``shards``, ``single``, ``lane``; None before
            ``make_env`` has returned.
    """

    error: WorkerDiedError | WorkerTimeoutError
    label: str
    provenance: dict[str, Any]
    load: m.Load
    options: dict[str, Any]
    task: dict[str, Any] | None


class Recorder:
    """Records nothing. Not thread-safe: the environment that owns it holds a lock."""

    def started(self) -> None:
        """Note that some or all sub-environments run in new processes."""

    def step(self, actions: Any) -> None:
        """Record a step of all sub-environments, with its validated batch of actions."""

    def requested(self, request: Request) -> None:
        """Record any other request, as it was sent."""

    def of_part(self) -> Recorder:
        """The recorder for one worker, when this recorder is for the whole environment."""
        return self

    def write(self, folder: Path, crash: Crash) -> Path | None:
        """Write a crash bundle; returns its folder, or None for no bundle. Raises ``OSError``."""


def recorder_for(limit: int) -> Recorder:
    """A recorder of at most ``limit`` requests."""
    history = extras.find("envhub_sandbox.extras.crash.history", "History") if limit else None
    return Recorder() if history is None else history(limit)
