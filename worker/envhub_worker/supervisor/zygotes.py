"""The zygotes of a worker server: one for each runtime, and each part of a policy that it needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.loop import Loop
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.runtime import Runtime
from envhub_worker.spawn.jail import Jail
from envhub_worker.spawn.spawner import JailExited, Spawner
from envhub_worker.spawn.zygote_process import ZygoteProcess
from envhub_worker.supervisor.jail_events import JailEvents
from envhub_worker.supervisor.records import JailRecord

MAX_IDLE_ZYGOTES = 2
"""Without a jail, when another is started. A client mostly has one policy, or two in turns."""
_OF_POLICY = ("profile", "network", "readable", "gpu", "record_denials")

Key = tuple[object, ...]


class Zygotes:
    """Started when a jail needs one, ended when they are too many.
    ``ahead``: a process for the first of them.
    """

    def __init__(
        self,
        loop: Loop,
        runtime_dir: Path,
        readable_roots: Sequence[str],
        jails: Mapping[int, JailRecord],
        events: JailEvents,
        ahead: ZygoteProcess | None,
    ) -> None:
        self._loop = loop
        self._runtime_dir = runtime_dir
        self._readable_roots = tuple(readable_roots)
        self._jails = jails
        self._events = events
        self._ahead = ahead
        self._spawners: dict[Key, Spawner] = {}

    def close(self) -> None:
        """End them all, and with them what is left of their jails."""
        for spawner in self._spawners.values():
            spawner.close()
        if self._ahead is not None:
            self._ahead.discard()

    @property
    def packages(self) -> frozenset[str]:
        """The folders of packages that they are for."""
        runtimes = (key[0] for key in self._spawners)
        return frozenset(one.packages for one in runtimes if isinstance(one, Runtime))

    def fork(self, runtime: Runtime, spec: JailSpec) -> tuple[Key, Jail]:
        """A jail, and the name of the zygote that it is a fork of."""
        # a zygote is one environment's: not even what it has not imported is shared with another
        key = (runtime, *(getattr(spec.confinement, name) for name in _OF_POLICY))
        spawner = self._spawners.pop(key, None) or self._start(key, runtime, spec.confinement)
        self._spawners[key] = spawner  # the one that was used last is the last
        return key, spawner.spawn(spec)

    def _start(self, key: Key, runtime: Runtime, confinement: Confinement) -> Spawner:
        self._end_idle()
        ahead, self._ahead = self._ahead, None
        spawner = Spawner(
            confinement,
            runtime_dir=self._runtime_dir,
            readable_roots=self._readable_roots,
            runtime=runtime,
            ahead=ahead,
        )
        self._loop.watch(spawner.fileno(), lambda: self._poll(key))
        return spawner

    def _end_idle(self) -> None:
        """A client with ever new policies does not fill the machine with warm interpreters."""
        used = {entry.zygote for entry in self._jails.values() if not entry.released}
        idle = [key for key in self._spawners if key not in used]
        for key in idle[: max(0, len(idle) - MAX_IDLE_ZYGOTES)]:
            spawner = self._spawners.pop(key)
            self._loop.unwatch(spawner.fileno())
            spawner.close()

    def _poll(self, key: Key) -> None:
        for event in self._spawners[key].poll():
            if isinstance(event, JailExited):
                self._events.jail_gone(event)
            else:
                spawner = self._spawners.pop(key)
                self._loop.unwatch(spawner.fileno())
                self._events.zygote_died(key, event)
                spawner.close()
