"""The environments that a caller gets, of a remembered manifest or out of a first jail."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

from envhub_sandbox.session.crash.history import History
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.jails.launcher import Launcher
from envhub_sandbox.session.jails.loaded import ExpectedManifest, LoadedJail
from envhub_sandbox.session.jails.retry_while_busy import retry_while_busy
from envhub_sandbox.session.jails.sources import JailSource, SharedJail
from envhub_sandbox.session.manifest_cache import ManifestCache, manifest_key
from envhub_sandbox.session.parts.fleet_session import AnySession, FleetSession
from envhub_sandbox.session.prewarm import SuitePrewarm, TaskPrewarm
from envhub_sandbox.session.recipe import provenance_of
from envhub_sandbox.system.folders import cache_root
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.shard_trials import ShardTrials
from envhub_sandbox.vector.suites import EnvSuites
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol.manifest.manifest import EnvManifest, Manifest


class EnvFactory:
    """Makes the proxies, from the remembered manifest or from a first jail.

    Args:
        launchers: Open jails: one for each worker that an environment is spread over, or one
            alone.
        num_workers: Over how many processes sub-environments are spread; None for as many as help.
        prewarm: How many tasks are started ahead; None for what is seen to help.
        face: The class that callers get.
        agrees: Raises where the repository is not what was locked.
    """

    def __init__(
        self,
        launchers: Sequence[Launcher],
        num_workers: int | None,
        prewarm: int | None,
        face: type[SandboxVectorEnv],
        agrees: Callable[[Manifest], None],
    ) -> None:
        self._face = face
        self._agrees = agrees
        self._launchers = launchers
        self._launcher = launcher = launchers[0]
        self._repository = repository = launcher.repository
        self._num_workers = num_workers
        self._prewarm = prewarm
        load = repository.arguments.message()
        key = manifest_key(repository.snapshot, load, repository.policy, launcher.runs_on)
        self._cache = ManifestCache(cache_root() / "manifests", key)

    def make(self) -> EnvSuites:
        """The environments; a first jail is opened where nothing is remembered of them."""
        repository = self._repository
        manifest = self._cache.load(max_elements=repository.policy.limits.elements)
        if manifest is not None:
            self._agrees(manifest)
            return self._suites(manifest, None)
        with repository.named():
            deadline = Deadline(repository.timeouts.startup_s)
            ask = partial(self._launcher.open, deadline)
            try:
                loaded = retry_while_busy(ask, self._launcher.retry_s, deadline, repository.label)
            except BaseException:
                repository.show_warnings()
                raise
        self._cache.save(loaded.value)
        try:
            self._agrees(loaded.manifest)
            suites = self._suites(loaded.manifest, loaded)
            repository.show_warnings()
            return suites
        except BaseException:
            self._launcher.close(loaded)
            raise

    def _suites(self, manifest: Manifest, loaded: LoadedJail | None) -> EnvSuites:
        repository = self._repository
        alone = manifest.lazy or len(manifest.envs) == 1
        shared = None if alone else self._shared(loaded)
        sessions = [self._session(manifest, env, shared) for env in manifest.envs]
        if loaded is not None and shared is None:
            self._use(loaded, sessions)
        envs: dict[str, dict[Any, Any]] = {}
        suites: dict[str, list[TaskPrewarm]] = {}
        for session in sessions:
            env = session.manifest
            envs.setdefault(env.suite, {})[env.task] = self._face(session)
            suites.setdefault(env.suite, []).append(session.prewarm)
        if shared is None and self._prewarm != 0:
            SuitePrewarm(list(suites.values()), self._prewarm)
        return EnvSuites(
            envs,
            lambda: provenance_of(
                repository.snapshot,
                manifest,
                repository.latest_report,
                repository.installed,
                repository.latest_profile,
                repository.places,
            ),
            partial(_close_all, shared or ()),
            repository.recipe,
        )

    def _shared(self, loaded: LoadedJail | None) -> list[SharedJail]:
        """A jail for all environments, for each worker."""
        shared = [SharedJail(launcher, self._cache.forget) for launcher in self._launchers]
        if loaded is not None:
            shared[0].provide(loaded)
        return shared

    def _session(
        self, manifest: Manifest, env: EnvManifest, shared: list[SharedJail] | None
    ) -> AnySession:
        workers = min(len(self._launchers), env.num_envs) if env.shardable else 1
        trials = self._cache.shard_trials(self._repository.lane)
        bounds = trials.bounds_for(env, self._num_workers if workers == 1 else workers)
        forget = self._cache.forget

        def source(worker: int, shards: int) -> JailSource:
            if shared is not None:
                return shared[worker]
            expected = ExpectedManifest(manifest, env, shards)
            return JailSource(self._launchers[worker], forget, expected)

        if workers == 1:
            return EnvSession(source(0, len(bounds)), env, bounds, trials)
        history, unnoted = History(env, self._repository.policy.crash_history), ShardTrials(None)
        parts = [
            EnvSession(source(worker, 1), env, [rows], unnoted, history)
            for worker, rows in enumerate(bounds)
        ]
        return FleetSession(parts, history)

    def _use(self, loaded: LoadedJail, sessions: list[AnySession]) -> None:
        """The jail that gave the manifest becomes the only task's; a suite closes it."""
        if len(sessions) == 1:
            with self._repository.named():
                sessions[0].prewarm.adopt(loaded)
        else:
            self._launcher.close(loaded)


def _close_all(shared: Iterable[SharedJail]) -> None:
    with ExitStack() as stack:  # interruption.md, rule 9
        for one in shared:
            stack.callback(one.close)
