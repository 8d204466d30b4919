"""``make_env``: reference -> snapshot -> sandbox -> proxies."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from envhub_sandbox import arguments
from envhub_sandbox.config import plain_config
from envhub_sandbox.dependencies.choice import chosen
from envhub_sandbox.dependencies.cure import cure
from envhub_sandbox.dependencies.prepare import provided
from envhub_sandbox.errors import PolicyError
from envhub_sandbox.hub import store
from envhub_sandbox.hub.snapshot import named
from envhub_sandbox.locks import use as locks
from envhub_sandbox.policy import Limits, Policy, Timeouts, policy_from, timeouts_from
from envhub_sandbox.sandboxes import inprocess
from envhub_sandbox.sandboxes.base import Sandbox
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.jails.launcher import Launcher
from envhub_sandbox.session.jails.line import wait_in_line
from envhub_sandbox.session.jails.loaded import Known, LoadedJail
from envhub_sandbox.session.jails.sources import JailSource, OwnJails, SharedJail
from envhub_sandbox.session.manifest_cache import ManifestCache, manifest_key
from envhub_sandbox.session.prewarming import Prewarming
from envhub_sandbox.session.provenance import provenance_of
from envhub_sandbox.session.recipe import Recipe, pinned
from envhub_sandbox.session.repository import LoadArguments, Repository
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.shared_memory.sharding import bounds_for
from envhub_sandbox.vector.suites import EnvSuites
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol.manifest import EnvManifest, Manifest
from envhub_worker.protocol.runtime import Runtime


def make_env(
    cfg: Any,
    n_envs: int = 1,
    use_async_envs: bool = False,
    hub_cache_dir: str | Path | None = None,
    trust_remote_code: bool = False,
    *,
    sandbox: str | Sandbox | None = "process",
    env_kwargs: Mapping[str, Any] | None = None,
    policy: Policy | Mapping[str, Any] | None = None,
    timeouts: Timeouts | Mapping[str, Any] | None = None,
    limits: Limits | Mapping[str, Any] | None = None,
    token: str | bool | None = None,
    endpoint: str | None = None,
    python: str | Path | None = None,
    dependencies: str | os.PathLike[str] | Mapping[str, Any] = "auto",
    lock: str | os.PathLike[str] | None = None,
    num_workers: int | None = None,
    prewarm: int | None = None,
    lane: str = "auto",
    copy: bool = True,
    validate: bool = False,
    server_key: str | None = None,
) -> EnvSuites:
    """Make the vector environments of a repository, without its code entering this process.

    Args:
        cfg: A hub reference (``"org/repo@commit:path"``), a local folder (``"./my-env"``), a
            ``.py`` file that is here (``"env.py"``), or a ``HubEnvConfig``-like object with
            ``hub_path``, whose ``vars()`` and public properties the repository's ``make_env``
            gets as ``cfg``.
        n_envs: Number of sub-environments, passed to the repository's ``make_env``.
        use_async_envs: Passed on likewise; sub-environments may then run in several processes.
        hub_cache_dir: huggingface_hub's ``cache_dir``.
        trust_remote_code: Only for ``sandbox=None``.
        sandbox: ``"process"``; ``"docker"``, ``"docker:IMAGE"`` or a ``DockerSandbox``;
            ``"tcp://HOST:PORT"`` or a ``RemoteSandbox``; or None to run the code here, as LeRobot
            does, where nothing of what protects can be asked for.
        env_kwargs: Further keyword arguments for the repository's ``make_env``.
        policy: What the code may reach; see ``Policy``.
        timeouts: How long operations may take; see ``Timeouts``.
        limits: Hard caps; a mapping changes those of ``policy.limits`` that it names.
        token: As in huggingface_hub.
        endpoint: As in huggingface_hub.
        python: The interpreter that runs the repository; this one by default. It needs cloudpickle,
            gymnasium, msgpack and numpy beside the repository's own packages.
        dependencies: Where its packages come from. ``"auto"`` makes an environment of its own from
            what it declares, wheels only, where this interpreter lacks some of that; ``"host"``
            takes this interpreter as it is; a path that interpreter or virtual environment. A
            mapping always makes one: ``{"extra": ["scipy"], "python": "3.12", "exclude_newer":
            "2026-01-31"}``. See ``docs/dependencies.md``; for ``sandbox="process"``.
        lock: A file that ``envhub lock`` wrote: its packages are used and no others, and whatever
            differs from it (commit, files, Python, spaces) is refused. For ``sandbox="process"``.
        num_workers: Processes over which the sub-environments are spread; by default one, or with
            ``use_async_envs`` as many as are useful for the cores there are.
        prewarm: How many of a suite's next tasks are started in the background when a task is first
            reset, and so how many jails there are at most that nobody has used yet. By default one,
            once tasks are seen to be closed before the next is reset, on this machine and without
            a GPU; else none.
        lane: ``"auto"`` steps over shared memory where that is possible, ``"frames"`` never does.
        copy: False lends observations instead of copying them, as in Gymnasium; still no later
            step changes an array that somebody holds, but the worker could.
        validate: Hold every action and observation against its space, value by value: for tests,
            at the cost of speed. Shapes and dtypes are checked in any case.
        server_key: For ``sandbox="tcp://..."``: that server's public key.

    Returns:
        ``{suite: {task_id: VectorEnv}}``. Environments of a known pin start no process before
        they are used.

    Raises:
        HubReferenceError: ``cfg`` cannot be read.
        TypeError, ValueError: A plain argument that nothing can be made of.
        SnapshotError: The files cannot be had, or are not what the commit says.
        PolicyError: An unknown or impossible policy, limit or timeout.
        SandboxUnavailableError: This host cannot enforce the policy.
        LockError: The lock cannot be read; or something is not as it says (``LockDriftError``).
        DependencyError: Its packages cannot be had, or it imports one that it does not declare.
        LoadError: The repository failed to load, or returned something unusable.
        WorkerError: The worker did not come up, died, or took too long; or a server has no room
            (``ServerBusyError``).
        RuntimeError: ``sandbox=None`` without ``trust_remote_code=True``.
    """
    reference, config = _reference(cfg)
    if lane not in _LANES:
        raise PolicyError(f"lane is {lane!r}; it is one of {', '.join(_LANES)}")
    n_envs = arguments.sub_environments(n_envs)
    use_async_envs = arguments.flag("use_async_envs", use_async_envs)
    num_workers = arguments.workers(num_workers)
    prewarm = arguments.ahead(prewarm)
    further = arguments.keyword_arguments(env_kwargs)
    if sandbox is None:
        if not trust_remote_code:
            raise inprocess.refusal(reference)
        arguments.only_in_a_sandbox(
            {
                "policy": policy,
                "timeouts": timeouts,
                "limits": limits,
                "python": python,
                "dependencies": None if dependencies == "auto" else dependencies,
                "lock": lock,
                "num_workers": num_workers,
                "prewarm": prewarm,
                "validate": validate,
                "server_key": server_key,
            }
        )
    locked = None if lock is None else locks.opened(lock, sandbox, python, dependencies)
    choice, python = chosen(dependencies, python)
    if choice.where == "own" and sandbox not in ("process", None):
        raise PolicyError(
            "dependencies={...} is for sandbox='process'. For a container, build an image: envhub "
            "image build REF; on another host, whoever runs the server chooses its packages"
        )
    chosen_policy = policy_from(policy, limits)
    chosen_timeouts = timeouts_from(timeouts)
    place = None if sandbox is None else _sandbox(sandbox, server_key)
    runs_on = Runtime(arguments.interpreter(python))
    if sandbox == "process":
        arguments.check_executable(runs_on.python)
        arguments.check_readable(chosen_policy.readable)
    snapshot = named(reference, hub_cache_dir=hub_cache_dir, token=token, endpoint=endpoint)
    if place is None:
        envs = inprocess.make(snapshot, n_envs, use_async_envs, config, further)
        return EnvSuites(envs, lambda: provenance_of(snapshot, None, []))
    environment = None
    if locked is not None:
        environment = locks.provided(snapshot, locked)
    elif sandbox == "process":
        environment = provided(snapshot, choice)
    if environment is not None:
        runs_on = Runtime(environment.python, str(environment.packages))
    repository = Repository(
        snapshot,
        LoadArguments(
            n_envs=n_envs,
            use_async_envs=use_async_envs,
            cfg=None if config is None else plain_config(config),
            env_kwargs=further,
        ),
        chosen_policy,
        chosen_timeouts,
        runs_on,
        lane,
        copy,
    )
    repository.installed = None if environment is None else environment.facts
    repository.cure = partial(cure, snapshot, place.name, choice, python, environment)
    repository.recipe = Recipe(
        make_env=make_env,
        reference=pinned(snapshot),
        config=repository.arguments.cfg,
        options={
            "n_envs": n_envs,
            "use_async_envs": use_async_envs,
            "hub_cache_dir": hub_cache_dir,
            "sandbox": sandbox,
            "env_kwargs": repository.arguments.env_kwargs,
            "policy": chosen_policy,
            "timeouts": chosen_timeouts,
            "endpoint": endpoint,
            "python": python,
            "dependencies": "auto" if python is not None else dependencies,
            "lock": None if lock is None else os.path.abspath(lock),
            "num_workers": num_workers,
            "prewarm": prewarm,
            "lane": lane,
            "copy": copy,
            "validate": validate,
            "server_key": server_key,
        },
    )
    if prewarm is None and (sandbox != "process" or chosen_policy.gpu):
        prewarm = (
            0  # a container's memory is all its jails', a quota all a key's, a GPU everybody's
        )
    agrees = locks.checker(locked, snapshot.label, further, config)
    launcher = Launcher(repository, place, store.cache_root() / "snapshots")
    return _Maker(launcher, num_workers, prewarm, _face(validate), agrees).make()


def _face(validate: bool) -> type[SandboxVectorEnv]:
    if not validate:
        return SandboxVectorEnv
    from envhub_sandbox.vector.validated import ValidatedVectorEnv

    return ValidatedVectorEnv


_LANES = ("auto", "frames")


class _Maker:
    """Makes the proxies, from the remembered manifest or from a first jail."""

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
        self._cache = ManifestCache(store.cache_root() / "manifests", key)

    def make(self) -> EnvSuites:
        repository = self._repository
        manifest = self._cache.load(max_elements=repository.policy.limits.elements)
        if manifest is not None:
            self._agrees(manifest)
            return self._suites(manifest, None)
        with repository.named():
            deadline = Deadline(repository.timeouts.startup_s)
            ask = partial(self._launcher.open, deadline)
            try:
                loaded = wait_in_line(ask, self._launcher.retry_s, deadline, repository.label)
            except BaseException:
                repository.tell()
                raise
        self._cache.save(loaded.value)
        try:
            self._agrees(loaded.manifest)
            suites = self._suites(loaded.manifest, loaded)
            repository.tell()
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
        suites: dict[str, list[EnvSession]] = {}
        for session in sessions:
            env = session.manifest
            envs.setdefault(env.suite, {})[env.task] = self._face(session)
            suites.setdefault(env.suite, []).append(session)
        if shared is None and self._prewarm != 0:
            Prewarming(list(suites.values()), self._prewarm)
        return EnvSuites(
            envs,
            lambda: provenance_of(
                repository.snapshot, manifest, repository.latest_report, repository.installed
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
        paces = self._cache.paces
        bounds = bounds_for(env, self._num_workers, paces.of(env))
        known = Known(manifest, env, len(bounds))
        own = OwnJails(self._launcher, self._cache.forget, known)
        source: JailSource = own if shared is None else shared
        return EnvSession(source, env, bounds, paces)

    def _use(self, loaded: LoadedJail, sessions: list[EnvSession]) -> None:
        """The jail that told the manifest becomes the only task's; a suite holds none in stock."""
        if len(sessions) == 1:
            with self._repository.named():
                sessions[0].head_start.adopt(loaded)
        else:
            self._launcher.close(loaded)


def _reference(cfg: Any) -> tuple[str, Any]:
    """The reference in ``cfg``, and the config object if it is one."""
    if isinstance(cfg, str):
        return cfg, None
    if isinstance(cfg, os.PathLike):
        return os.path.abspath(cfg), None
    hub_path = getattr(cfg, "hub_path", None)
    if isinstance(hub_path, os.PathLike):
        return os.path.abspath(hub_path), cfg
    if isinstance(hub_path, str):
        return hub_path, cfg
    kind = f"{type(cfg).__module__}.{type(cfg).__qualname__}"
    if hasattr(cfg, "hub_path"):
        raise TypeError(f"cfg is a {kind} whose hub_path is {hub_path!r}; it takes a hub reference")
    raise TypeError(f"cfg is a hub reference, a folder, or an object with a hub_path, not {kind}")


def _sandbox(sandbox: str | Sandbox, server_key: str | None) -> Sandbox:
    if isinstance(sandbox, str) and sandbox.startswith("tcp://"):
        from envhub_sandbox.sandboxes.remote import RemoteSandbox

        return RemoteSandbox(sandbox, server_key=server_key)
    if server_key is not None:
        raise PolicyError(
            "server_key is for sandbox='tcp://HOST:PORT'; a RemoteSandbox has its own"
        )
    if not isinstance(sandbox, str):
        if not callable(getattr(sandbox, "acquire", None)):
            raise _unknown(sandbox)
        return sandbox
    if sandbox == "process":
        from envhub_sandbox.sandboxes.process import PROCESS

        return PROCESS
    kind, _, image = sandbox.partition(":")
    if kind == "docker":
        from envhub_sandbox.sandboxes.docker.sandbox import DockerSandbox

        return DockerSandbox(image=image) if image else DockerSandbox()
    raise _unknown(sandbox)


def _unknown(sandbox: object) -> PolicyError:
    return PolicyError(
        f"sandbox is {sandbox!r}; it is 'process', 'docker', 'tcp://HOST:PORT', or None to run the "
        "code here"
    )
