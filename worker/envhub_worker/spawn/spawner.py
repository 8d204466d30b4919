"""The server's side of a zygote and of the jails that it forks. Nothing here blocks.

A ``Spawner`` is one zygote. ``spawn`` returns a ``Jail`` at once. ``Spawner.poll`` and
``Jail.poll`` return later events; call them when their descriptors are readable.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from envhub_worker.lockdown.context import ZygoteConfig
from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.limits import cgroups
from envhub_worker.lockdown.mechanisms import user
from envhub_worker.lockdown.mechanisms.locked_folder import LockedFolder
from envhub_worker.lockdown.mechanisms.scratch import remove_tree
from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.runtime import OWN, RECORD, Runtime
from envhub_worker.spawn.channel import close_fds
from envhub_worker.spawn.jail import Jail
from envhub_worker.spawn.zygote_process import ZygoteProcess, ends_within

_END_S = 8.0
_LOG_TAIL_BYTES = 8192
RUNNER_TARGET = "envhub_worker.runner.runner:main"


@dataclass(frozen=True)
class ZygoteDied:
    """The zygote has ended, and every jail with it.
    ``code``: its exit code, or minus the signal that ended it.
    """

    code: int
    log: str


@dataclass(frozen=True)
class JailExited:
    """The init of ``jail`` has ended, and every process of the jail with it."""

    jail: Jail
    code: int | None
    signal: int | None


SpawnerEvent = ZygoteDied | JailExited


class Spawner:
    """One zygote. Owns its process, its jails and a private folder below ``runtime_dir``."""

    def __init__(
        self,
        confinement: Confinement,
        *,
        runtime_dir: Path,
        readable_roots: Sequence[str],
        runtime: Runtime = OWN,
        target: str = RUNNER_TARGET,
        ahead: ZygoteProcess | None = None,
    ) -> None:
        """Execute the zygote; it preloads in the background.

        Args:
            confinement: The confinement that the zygote's jails share.
            target: The function that confined runners call: ``"module:function"``, or
                ``"/a.py:function"``.
            ahead: A zygote process started earlier; used if it has the right arguments, else ended.
        """
        self._jails: dict[int, Jail] = {}  # by the number that messages to the zygote have
        self._count = 0  # jails so far; the number of the last one
        # The zygote's own, once it is ready: with namespaces it is a child of the started process.
        self._pidfd = -1
        self._exited = False  # the zygote has ended, and all jails with it
        if ahead is not None and not ahead.serves(runtime, confinement.environment):
            ahead.discard()
            ahead = None
        self._process = ahead or ZygoteProcess(runtime, runtime_dir, confinement.environment)
        self._folder = self._process.folder
        self._user: int | None = None  # the user that root's jails become
        refusal = None
        try:
            self._user = user.choose()
        except LayerUnavailableError as error:
            refusal = error.to_wire()
        # Holds the scratches where that user can reach them.
        self._apart: LockedFolder | None = None
        # The parent of the jails' writable folders; None if they mount their own.
        self._scratches = self._make_scratches(confinement)
        self._cgroups = self._make_cgroups()
        self._channel = self._process.channel
        self._in_use = _keep(runtime.packages)  # the lock that keeps the packages from removal
        root = self._folder / "root"
        root.mkdir()
        config = ZygoteConfig(
            parent=os.getpid(),
            target=target,
            profile=confinement.profile,
            network=confinement.network,
            gpu=confinement.gpu,
            readable=confinement.readable,
            packages=runtime.packages and os.path.realpath(runtime.packages),
            roots=tuple(readable_roots),
            place=str(root),
            canary=str(self._process.log),
            user=self._user,
            record=confinement.record_denials,
            refusal=refusal,
        )
        self._channel.send(asdict(config))

    def _make_scratches(self, confinement: Confinement) -> Path | None:
        """Makes the parent of writable folders for jails without a mount namespace, if needed."""
        if confinement.profile == "strict":
            return None
        if self._user is None:
            return self._folder
        # The jails' user may not cross root's runtime folder.
        self._apart = LockedFolder("envhub-scratch-")
        self._apart.path.chmod(0o711)
        return self._apart.path

    def _make_cgroups(self) -> cgroups.Tree | None:
        hierarchy = cgroups.discover()
        if hierarchy is not None:
            with contextlib.suppress(OSError):
                return cgroups.Tree(hierarchy, self._folder.name)
        return None

    def fileno(self) -> int:
        """A descriptor that is readable when ``poll`` has events."""
        return self._channel.fileno()

    def poll(self) -> list[SpawnerEvent]:
        """Returns the events since the last call."""
        if self._exited:
            return []
        self._channel.flush()
        messages, ended = self._channel.drain()
        events = [event for message, fds in messages for event in self._take(message, fds)]
        return events + self._died() if ended else events

    def _take(self, message: dict[str, Any], fds: list[int]) -> list[SpawnerEvent]:
        kind = message["event"]
        if kind == "ready":
            self._pidfd = fds[0]
        elif kind == "spawned":
            self._jails[message["id"]].attach(fds[0])
        else:
            jail = self._jails.pop(message["id"])
            jail.release()
            return [JailExited(jail, message["code"], message["signal"])]
        return []

    def _died(self) -> list[SpawnerEvent]:
        self._exited = True
        code = self._reap_zygote()
        log = ""
        with contextlib.suppress(OSError):  # no descriptor is left: the events are needed anyway
            log = self._process.log.read_bytes()[-_LOG_TAIL_BYTES:].decode(errors="replace")
        events: list[SpawnerEvent] = [ZygoteDied(code, log)]
        events += [JailExited(jail, None, int(signal.SIGKILL)) for jail in self._jails.values()]
        self._release_jails()
        return events

    def _release_jails(self) -> None:
        for jail in self._jails.values():
            jail.release()
        self._jails.clear()

    def _reap_zygote(self) -> int:
        """Wait for the end of the zygote and of all processes that it started."""
        code = self._process.wait()
        if self._pidfd >= 0:
            # With namespaces the zygote is a child of the started process, and is killed with it.
            ends_within(self._pidfd, _END_S)
            os.close(self._pidfd)
            self._pidfd = -1
        return code

    def spawn(self, spec: JailSpec) -> Jail:
        """Ask for a jail. Requests wait until the zygote is ready. Raises ``RuntimeError``."""
        if self._exited:
            raise RuntimeError("the zygote has ended")
        self._count += 1
        # Mounts and Landlock need real paths.
        spec = replace(spec, snapshot=os.path.realpath(spec.snapshot))
        folder = None if self._scratches is None else self._scratches / f"jail-{self._count}"
        jail = Jail(spec, folder, self._user)
        try:
            # In this order. The specification waits in init's own channel before there is an init.
            # So init finds it at once, and the zygote, whose memory later jails inherit, never sees
            # it.
            jail.describe(self._make_group(spec))
            self._channel.send({"op": "spawn", "id": self._count}, jail.theirs)
        except BaseException:
            jail.give_up()
            raise
        self._jails[self._count] = jail
        close_fds(jail.theirs)
        return jail

    def _make_group(self, spec: JailSpec) -> cgroups.Group | None:
        if self._cgroups is not None:
            with contextlib.suppress(OSError):
                return self._cgroups.group(f"jail-{self._count}", spec.confinement.limits)
        return None

    def close(self) -> None:
        """End every process of every jail and the zygote, reap, remove the files. Idempotent."""
        for jail in self._jails.values():
            jail.kill()
        self._channel.close()
        if not self._exited:
            self._reap_zygote()
            self._exited = True
        self._release_jails()
        if self._cgroups is not None:
            self._cgroups.remove()
            self._cgroups = None
        remove_tree(str(self._folder))
        if self._apart is not None:
            self._apart.remove()
        if self._in_use is not None:
            os.close(self._in_use)
            self._in_use = None


def _keep(packages: str) -> int | None:
    """Returns a descriptor that holds the lock of the packages' record, so that nobody removes
    them; None without a record.
    """
    if not packages:
        return None
    record = os.path.join(os.path.dirname(os.path.realpath(packages)), RECORD)
    descriptor = None
    with contextlib.suppress(OSError):  # none, or they are being removed: a jail then says so
        descriptor = os.open(record, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    return descriptor
