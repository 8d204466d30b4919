"""An open jail whose runners have called the repository's ``make_env``, and what that returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from envhub_sandbox.sandboxes.pool import ServerUse, WorkerServer
from envhub_sandbox.system.processes import OwnerProcess
from envhub_sandbox.transport.jail import JailHandle
from envhub_worker.protocol.manifest.manifest import EnvManifest, Manifest


@dataclass(frozen=True)
class ExpectedManifest:
    """What a repository's ``make_env`` has returned before.

    Attributes:
        task: The environment that a jail is wanted for.
        shards: Over how many runners it is going to be spread.
    """

    manifest: Manifest
    task: EnvManifest
    shards: int = 1


@dataclass(eq=False)
class LoadedJail:
    """An open jail whose first runner has called ``make_env``.

    It has to be given back. Where a Ctrl-C comes between its taking and its noting, its
    finalizer does.

    Attributes:
        manifest: What ``make_env`` returned, checked.
        loaded: Runners that have called it.
        use: That of the server that it is in.
        address: What errors call the place of that.
        give_back: Gives it back: see ``Launcher.close`` and ``disconnect``.
        ending: Whether its end was begun.
        closing: Whether a call of ``Launcher.close`` is at it.
        ended: Whether it was asked for, so that only the server's use is left.
        closed: Whether all was given back.
        lost: Whether the connection to its server was.
        changed: Whether it returned something else in one of them than the manifest says.
    """

    jail: JailHandle
    manifest: Manifest
    value: dict[str, object]
    loaded: set[int]
    use: ServerUse[WorkerServer]
    give_back: Callable[[LoadedJail], None]
    address: str = ""
    ending: bool = False
    closing: bool = False
    ended: bool = False
    closed: bool = False
    lost: bool = False
    changed: bool = False
    owner: OwnerProcess = field(default_factory=OwnerProcess)

    @property
    def server(self) -> WorkerServer:
        """Where it is."""
        return self.use.server

    def __del__(self) -> None:
        # interruption.md, rule 5. At the end of the process no server is in use any more: nothing
        # is closed one by one there (rule 13).
        if "owner" not in vars(self):  # the last field: an interrupt came before there was a jail
            return
        if not self.closed and self.use.live and self.owner.is_here:
            self.ending = True  # its connection may have gone before it
            self.give_back(self)
