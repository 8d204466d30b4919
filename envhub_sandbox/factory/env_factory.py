"""The environments that a caller gets, of a remembered manifest or out of a first jail."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from envhub_sandbox.hub.cache import cache_root
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.jails.launcher import Launcher
from envhub_sandbox.session.jails.loaded import ExpectedManifest, LoadedJail
from envhub_sandbox.session.jails.retry_while_busy import retry_while_busy
from envhub_sandbox.session.jails.sources import JailSource, SharedJail
from envhub_sandbox.session.manifest_cache import ManifestCache, manifest_key
from envhub_sandbox.session.prewarm import Prewarm, SuitePrewarm
from envhub_sandbox.session.recipe import provenance_of
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.vector.suites import EnvSuites
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol.manifest.manifest import EnvManifest, Manifest


class EnvFactory:
    """Makes the proxies, from the remembered manifest or from a first jail.

    Args:
        launcher: Opens jails.
        num_workers: Over how many processes sub-environments are spread; None for as many as help.
        prewarm: How many tasks are started ahead; None for what is seen to help.
        face: The class that callers get.
        agrees: Raises where the repository is not what was locked.
    """

    def __init__(
        self,
        launcher: Launcher,
        num_workers: int | None,
        prewarm: int | None,
        face: type[SandboxVectorEnv],
        agrees: Callable[[Manifest], None],
    ) -> None:
        self._face = face
        self._agrees = agrees
        self._launcher = launcher
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
        shared = None if manifest.lazy or len(manifest.envs) == 1 else self._shared(loaded)
        sessions = [self._session(manifest, env, shared) for env in manifest.envs]
        if loaded is not None and shared is None:
            self._use(loaded, sessions)
        envs: dict[str, dict[Any, Any]] = {}
        suites: dict[str, list[Prewarm]] = {}
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
            ),
            shared.close if shared else lambda: None,
            repository.recipe,
        )

    def _shared(self, loaded: LoadedJail | None) -> SharedJail:
        shared = SharedJail(self._launcher, self._cache.forget)
        if loaded is not None:
            shared.provide(loaded)
        return shared

    def _session(
        self, manifest: Manifest, env: EnvManifest, shared: SharedJail | None
    ) -> EnvSession:
        trials = self._cache.shard_trials(self._repository.lane)
        bounds = trials.bounds_for(env, self._num_workers)
        expected = ExpectedManifest(manifest, env, len(bounds))
        source = shared or JailSource(self._launcher, self._cache.forget, expected)
        return EnvSession(source, env, bounds, trials)

    def _use(self, loaded: LoadedJail, sessions: list[EnvSession]) -> None:
        """The jail that gave the manifest becomes the only task's; a suite closes it."""
        if len(sessions) == 1:
            with self._repository.named():
                sessions[0].prewarm.adopt(loaded)
        else:
            self._launcher.close(loaded)
