"""An open jail whose runners have called the repository's ``make_env``, and what that returns."""

from __future__ import annotations

from dataclasses import dataclass

from envhub_sandbox.sandboxes.base import WorkerServer
from envhub_sandbox.transport.jail import JailHandle
from envhub_worker.protocol.manifest.manifest import EnvManifest, Manifest


@dataclass(frozen=True)
class Known:
    """What a repository's ``make_env`` has returned before.

    Attributes:
        manifest: All of it.
        task: The environment that a jail is wanted for.
        shards: Over how many runners it is going to be spread.
    """

    manifest: Manifest
    task: EnvManifest
    shards: int = 1


@dataclass
class LoadedJail:
    """An open jail whose first runner has called ``make_env``.

    Attributes:
        jail: The jail.
        manifest: What ``make_env`` returned, checked.
        loaded: Runners that have called it.
        changed: Whether it returned something else in one of them than the manifest says.
    """

    jail: JailHandle
    manifest: Manifest
    value: dict[str, object]
    loaded: set[int]
    server: WorkerServer
    closed: bool = False
    changed: bool = False
