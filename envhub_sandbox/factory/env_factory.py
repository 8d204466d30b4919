"""Makes a caller's environments, from a remembered manifest or from a first jail.

``ManifestCache`` remembers the manifest of a pinned repository's ``make_env``, so that the next
call starts no process. An entry is the worker's own message. It is checked when it is read, and
ignored if the check fails. The key has everything on which the manifest may depend.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import EnvHubError, LoadError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.sandboxes.sandbox import retry_while_busy
from envhub_sandbox.session.builder import JailSource, SharedJail
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.launcher import ExpectedManifest, Launcher, LoadedJail
from envhub_sandbox.session.prewarm import Prewarm, SuitePrewarm
from envhub_sandbox.session.recorder import recorder_for
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.system import extras, folders
from envhub_sandbox.system.folders import cache_root, write_whole_file
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.remote_warnings import SHARED_WARNING
from envhub_sandbox.transport.shard_trials import ShardTrials
from envhub_sandbox.transport.values import generator, pickled
from envhub_sandbox.vector.suites import EnvSuites
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker import protocol
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.limits import MAX_NUM_ENVS
from envhub_worker.protocol.manifest.manifest import EnvManifest, Manifest, decode_manifest
from envhub_worker.protocol.runtime import Runtime
from envhub_worker.protocol.stream import StreamReader, pack_packet
from envhub_worker.protocol.text import counted

SharedJails = dict[Launcher, SharedJail]

_FORMAT = 2
_APART = ".apart"
"""The suffix of the file beside an entry that says that sub-environments share state."""


class ManifestCache:
    """One entry of the cache; with the ``key`` None nothing is remembered."""

    def __init__(self, folder: Path, key: str | None) -> None:
        self._path = None if key is None else folder / key

    def shard_trials(self, lane: str) -> ShardTrials:
        """The step times of earlier uses over this lane, from a file beside the entry."""
        if self._path is None:
            return ShardTrials(None)
        path = self._path.with_suffix(f".{lane}-shards")
        return ShardTrials(path, apart=self._path.with_suffix(_APART).exists())

    def note_shared(self) -> None:
        """Remember that sub-environments need processes of their own, whatever the manifest says.
        Failing to write the cache is no error.
        """
        if self._path is not None:
            with contextlib.suppress(OSError):
                write_whole_file(self._path.with_suffix(_APART), b"")

    def load(self, *, max_elements: int) -> Manifest | None:
        """The remembered manifest; None if there is none, or if it cannot be read."""
        if self._path is None:
            return None
        try:
            if not folders.is_ours_alone(self._path.parent):
                return None
            [packet] = StreamReader().feed(self._path.read_bytes())
            message = m.unpack(packet.frames)
            if isinstance(message, m.LoadDone):
                return decode_manifest(
                    message.manifest, max_elements=max_elements, generator=generator
                )
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EnvHubError):
            self.forget()
        return None

    def save(self, value: dict[str, object]) -> None:
        """Remember a manifest. Failing to write the cache is no error."""
        if self._path is None:
            return
        data = b"".join(map(bytes, pack_packet(1, m.pack(m.LoadDone(value)))))
        with contextlib.suppress(OSError):
            folders.make_private(self._path.parent)
            write_whole_file(self._path, data)

    def forget(self) -> None:
        """Drop the entry."""
        if self._path is not None:
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)


def manifest_key(snapshot: Snapshot, load: m.Load, policy: Policy, runtime: Runtime) -> str | None:
    """The key of a manifest; None if an argument has no form that can be compared.

    Pickles of equal values may differ, as those of a set of texts in two processes: a cache miss.
    """
    try:
        arguments = b"".join(map(bytes, m.pack(load, pickler=partial(pickled, lasting=True))))
    except (EnvHubError, TypeError):
        return None
    # the interpreter, and the times when packages were last installed into it
    python = runtime.python or sys.executable
    prefix = Path(python).parent.parent
    own = sorted(prefix.glob("lib/python3*/site-packages"))
    folders = [Path(runtime.packages)] if runtime.packages else own
    facts = (
        *(_FORMAT, m.VERSION, _code_of(Path(protocol.__file__).parent.parent)),
        *(snapshot.repo_type, snapshot.repo_id, snapshot.commit, snapshot.path),
        [copy[:3] for copy in snapshot.hub_copies],
        *(policy.profile, policy.network, policy.readable, policy.gpu, policy.environment),
        policy.display,
        policy.record_denials,  # a host may refuse it, and the cache must not hide that
        *(python, _stamp(Path(python)), *((str(path), _stamp(path)) for path in folders)),
    )
    digest = hashlib.sha256(arguments)
    digest.update(repr(facts).encode())
    digest.update(b"".join(map(bytes, encode(policy.confinement().environment))))
    return digest.hexdigest()


@lru_cache(maxsize=8)
def _code_of(worker: Path) -> str:
    """A digest of the paths and change times of the worker's modules, which make the manifest.

    The folder's own change time is not enough: editing a module does not change it.
    """
    files = (Path(folder, name) for folder, _, names in os.walk(worker) for name in names)
    code = [path for path in files if path.suffix == ".py"]
    changes = sorted((str(path.relative_to(worker)), _stamp(path)) for path in code)
    return hashlib.sha256(repr(changes).encode()).hexdigest()


def _stamp(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


class EnvFactory:
    """Makes the proxies, from the remembered manifest or from a first jail.

    Args:
        launchers: Open the jails: one launcher for each worker.
        num_workers: The number of processes for the sub-environments; None for the fastest.
        prewarm: The number of tasks to start ahead; None to start one once that is seen to help.
        agrees: Raises if the manifest differs from the lock.
    """

    def __init__(
        self,
        launchers: Sequence[Launcher],
        num_workers: int | None,
        prewarm: int | None,
        agrees: Callable[[Manifest], None],
    ) -> None:
        self._agrees = agrees
        self._launchers = launchers
        self._launcher = launcher = launchers[0]
        self._repository = repository = launcher.repository
        self._num_workers = num_workers
        self._prewarm = prewarm
        identity = repository.snapshot, repository.arguments, repository.policy, launcher.runs_on
        key = manifest_key(*identity)
        self._cache = ManifestCache(cache_root() / "manifests", key)
        repository.warnings.note_shared = self._cache.note_shared
        repository.warnings.chosen = num_workers is not None or len(launchers) > 1

    def make(self) -> EnvSuites:
        """Make the environments, from the remembered manifest or by opening a first jail."""
        repository = self._repository
        manifest = self._cache.load(max_elements=repository.policy.limits.elements)
        if manifest is not None:
            self._agrees(manifest)
            return self._suites(manifest, None)
        with repository.named():
            deadline = Deadline(repository.timeouts.startup_s)
            try:
                loaded = self._open(deadline)
            except BaseException:
                repository.warnings.show(repository.label)
                raise
        self._cache.save(loaded.value)
        try:
            self._agrees(loaded.manifest)
            manifest = loaded.manifest
            # environments use the jail that described them, unless each task has its own jail
            is_used = not manifest.lazy or len(manifest.envs) == 1
            if is_used and any(
                e.shardable and not e.sync and e.num_envs > 1 for e in manifest.envs
            ):
                self._launcher.close(loaded)  # what was played in it may have written files
                played = loaded.manifest
                with repository.named():
                    loaded = self._open(deadline, ExpectedManifest(played, played.envs[0]))
            suites = self._suites(loaded.manifest, loaded)
            repository.warnings.show(repository.label)
            return suites
        except BaseException:
            self._launcher.close(loaded)
            raise

    def _open(self, deadline: Deadline, expected: ExpectedManifest | None = None) -> LoadedJail:
        ask = partial(self._launcher.open, deadline, expected)
        return retry_while_busy(ask, self._launcher.retry_s, deadline, self._repository.label)

    def _suites(self, manifest: Manifest, loaded: LoadedJail | None) -> EnvSuites:
        repository = self._repository
        shared: SharedJails | None = None
        if not manifest.lazy and len(manifest.envs) != 1:
            # all environments share a jail for each worker
            jails = [SharedJail(launcher, self._cache.forget) for launcher in self._launchers]
            shared = dict(zip(self._launchers, jails, strict=True))
            if loaded is not None:
                shared[self._launcher].provide(loaded)
        self._bound_parts(manifest)
        makers = [partial(self._session, manifest, env, shared) for env in manifest.envs]
        sessions = [make() for make in makers]
        if loaded is not None and shared is None:
            # the only task gets the jail that described the repository; a suite closes it
            if len(sessions) == 1:
                with self._repository.named():
                    sessions[0].prewarms[0].adopt(loaded)
            else:
                self._launcher.close(loaded)
        envs: dict[str, dict[Any, Any]] = {}
        suites: dict[str, list[list[Prewarm]]] = {}
        for session, again in zip(sessions, makers, strict=True):
            env = session.manifest
            envs.setdefault(env.suite, {})[env.task] = SandboxVectorEnv(session, again)
            suites.setdefault(env.suite, []).append(session.prewarms)
        if shared is None and self._prewarm != 0:
            SuitePrewarm(list(suites.values()), self._prewarm)
        return EnvSuites(
            envs,
            partial(repository.provenance, manifest),
            partial(_close_all, {} if shared is None else shared),
            repository.recipe,
        )

    def _bound_parts(self, manifest: Manifest) -> None:
        """Refuse a manifest whose sub-environments would be absurdly many workers of a fleet."""
        if self._num_workers is not None or len(self._launchers) == 1:
            return
        counts = [env.num_envs for env in manifest.envs if env.shardable and not env.sync]
        if sum(counts) > MAX_NUM_ENVS:
            raise LoadError(
                f"{self._repository.label}: its {sum(counts)} sub-environments may each need a "
                f"worker, and there are at most {MAX_NUM_ENVS}: give num_workers"
            )

    def _session(
        self, manifest: Manifest, env: EnvManifest, shared: SharedJails | None
    ) -> EnvSession:
        workers = min(len(self._launchers), env.num_envs) if env.shardable else 1
        trials = self._cache.shard_trials(self._repository.policy.lane)
        bounds = trials.bounds_for(env, self._num_workers if workers == 1 else workers)
        if self._num_workers is not None and env.shardable and not trials.may_share(env):
            self._warn_of_sharing(len(bounds), env.num_envs)
        forget = self._cache.forget

        def source(launcher: Launcher, shards: int) -> JailSource:
            if shared is None:
                expected = ExpectedManifest(manifest, env, shards)
                return JailSource(launcher, forget, expected)
            if launcher not in shared:
                shared[launcher] = SharedJail(launcher, forget)
            return shared[launcher]

        if workers == 1:
            return EnvSession(source(self._launcher, len(bounds)), env, bounds, trials)
        module = "envhub_sandbox.extras.several_workers.fleet_session"
        fleet_session = extras.required(module, "FleetSession", "several workers with jails")
        seats = list(zip(self._launchers, bounds))  # noqa: B905 - there may be more places
        if self._num_workers is None and not trials.may_share(env):
            # a worker for each sub-environment, in the same sandbox
            seats = [
                (launcher if index == start else launcher.another(), (index, index + 1))
                for launcher, (start, stop) in seats
                for index in range(start, stop)
            ]
        recorder = recorder_for(self._repository.policy.crash_history)
        unnoted = ShardTrials(None)  # one shard each: there is nothing to try
        parts = [
            EnvSession(source(launcher, 1), env, [rows], unnoted, recorder)
            for launcher, rows in seats
        ]
        fleet: EnvSession = fleet_session(parts, recorder)  # it has the same interface
        return fleet

    def _warn_of_sharing(self, processes: int, num_envs: int) -> None:
        """Warn if asynchronous sub-environments that may not share a process have to."""
        if processes < num_envs:
            text = (
                f"{num_envs} sub-environments share {counted(processes, 'process', 'processes')}, "
                "and were not shown to be independent of each other, so they may give other "
                "results than with AsyncVectorEnv, where each has one: leave "
                f"{option_name('num_workers')} out"
            )
            self._repository.warnings.collect((SHARED_WARNING, text))


def _close_all(shared: SharedJails) -> None:
    with ExitStack() as stack:  # interruption.md, rule 9
        for jail in shared.values():
            stack.callback(jail.close)
