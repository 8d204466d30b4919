"""``make_env``, and its steps: from a reference to snapshot, packages, sandbox and proxies."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import DependencyError, PolicyError
from envhub_sandbox.factory.env_factory import EnvFactory
from envhub_sandbox.factory.package_source import PackageSource, source_of
from envhub_sandbox.hub.snapshot import Snapshot, snapshot_named, with_assets
from envhub_sandbox.sandboxes import inprocess
from envhub_sandbox.sandboxes.sandbox import Sandbox, is_list
from envhub_sandbox.session.launcher import Launcher
from envhub_sandbox.session.repository import Recipe, Repository, plain_config, provenance_of
from envhub_sandbox.settings.options import Options, option_name, refuse_unknown_arguments
from envhub_sandbox.settings.policy import Limits, Policy, Timeouts, policy_from, timeouts_from
from envhub_sandbox.system import extras
from envhub_sandbox.system.folders import cache_root
from envhub_sandbox.system.platform import occupy_streams
from envhub_sandbox.vector.suites import EnvSuites, for_lerobot
from envhub_sandbox.vector.tracebacks import short_traceback
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.runtime import Runtime


@short_traceback
@refuse_unknown_arguments
def make_env(
    cfg: Any,
    n_envs: int = 1,
    use_async_envs: bool = False,
    hub_cache_dir: str | Path | None = None,
    trust_remote_code: bool = False,
    *,
    sandbox: str | Sandbox | Sequence[str | Sandbox] | None = "process",
    env_kwargs: Mapping[str, Any] | None = None,
    policy: Policy | Mapping[str, Any] | None = None,
    timeouts: Timeouts | Mapping[str, Any] | None = None,
    limits: Limits | Mapping[str, Any] | None = None,
    token: str | bool | None = None,
    endpoint: str | None = None,
    allow_secrets: bool = False,
    python: str | Path | None = None,
    dependencies: str | os.PathLike[str] | Mapping[str, Any] = "auto",
    lock: str | os.PathLike[str] | None = None,
    assets: Sequence[str] = (),
    num_workers: int | None = None,
    min_ready: int | None = None,
    copy: bool = True,
) -> EnvSuites:
    """Make the vector environments of a repository, without its code entering this process.

    Args:
        cfg: A hub reference (``"org/repo@commit:path"``), a reference of git
            (``"github:org/repo@commit:path"``), an id that a package registers
            (``"pypi:minigrid@3.0.0#MiniGrid-Empty-5x5-v0"``), a local folder (``"./my-env"``), a
            ``.py`` file (``"env.py"``: its code sees the files that it imports from its folder and
            those that git tracks), or a ``HubEnvConfig``-like object with
            ``hub_path``, whose ``vars()`` and public properties the repository's ``make_env``
            gets as ``cfg``.
        n_envs: Number of sub-environments, passed to the repository's ``make_env``.
        use_async_envs: Passed, too; if True, sub-environments may run in several processes.
        hub_cache_dir: huggingface_hub's ``cache_dir``.
        trust_remote_code: Needed for ``sandbox=None`` only. If True, environments are as LeRobot's
            ``make_env`` makes them: a ``reset`` after ``close`` opens one again, and the
            ``render_fps`` in their metadata is an integer.
        sandbox: Where the code runs: ``"process"``; ``"docker"``, ``"docker:IMAGE"`` or a
            ``DockerSandbox``; ``"ray"`` or a ``RaySandbox``; ``"tcp://HOST:PORT KEY"``, or
            without the server's public key if that is known, or a ``RemoteSandbox``. A list of
            these, or a ``Fleet``, spreads the sub-environments of each environment over several
            places (``docs/scaling.md``). None runs the code in this process without protection, as
            LeRobot does.
        env_kwargs: Further keyword arguments for the repository's ``make_env``.
        policy: What the code may reach; see ``Policy``.
        timeouts: How long operations may take; see ``Timeouts``.
        limits: Hard caps; a mapping changes those fields of ``policy.limits`` that it names.
        token: As in huggingface_hub.
        endpoint: As in huggingface_hub.
        allow_secrets: Also take a local folder that holds keys or passwords (``.ssh``, ``.env``,
            ``*.pem``), or is a home directory: its code sees them.
        python: The interpreter that runs the repository; this one by default. It needs cloudpickle,
            gymnasium, msgpack and numpy beside the repository's own packages.
        dependencies: Where its packages come from. ``"auto"`` installs what it declares and imports
            into a separate environment, if this interpreter lacks some of it; ``"declared"``
            installs only what it declares; ``"host"`` uses this interpreter's packages; a path
            uses those of that interpreter or virtual environment. A mapping always makes a
            separate environment:
            ``{"extra": ["scipy"], "python": "3.12", "exclude_newer": "2026-01-31"}``, also with
            ``only``, ``without``, ``override`` and ``fetch_python``. See ``docs/dependencies.md``.
        lock: A file of ``envhub lock``: its packages are used, and any difference from it (commit,
            files, Python, spaces) is an error. For ``sandbox="process"``.
        assets: Other repositories of the Hub that the code may read, at most sixteen, as in
            ``["datasets/org/data@<commit>"]``; without a prefix a model, a dataset or a Space. They
            are verified like its own files, and ``snapshot_download`` and ``hf_hub_download`` find
            them without a network. See ``docs/authors.md``.
        num_workers: Number of processes for the sub-environments. The default is one. With
            ``use_async_envs`` it is one for each sub-environment, as with ``AsyncVectorEnv``; those
            that were found to be independent of each other share as many as are fastest. Another
            number than these is warned of if results may depend on it. Several places in
            ``sandbox`` have at least one each. Of ``"ray"`` each has a server of its own, which Ray
            places.
        min_ready: How many sub-environments ``env.recv`` waits for by default. Each sub-environment
            then has its own worker, or ``num_workers`` workers share them: the sub-environments of
            one worker are stepped together, and so are ready together. ``reset`` and ``step`` work
            as before.
        copy: False returns observations in shared memory instead of copies. As in Gymnasium, no
            later step changes an array that is still in use; but the worker can.

    Returns:
        ``{suite: {task_id: VectorEnv}}``. Environments of a known pin start no process before
        they are used.

    Raises:
        HubReferenceError: ``cfg`` cannot be read.
        TypeError, ValueError: A plain argument is invalid.
        SnapshotError: The files cannot be downloaded, or differ from the commit.
        PolicyError: An unknown or impossible policy, limit or timeout; or a folder that holds keys.
        SandboxUnavailableError: This host cannot enforce the policy.
        LockError: The lock cannot be read; or something differs from it (``LockDriftError``).
        DependencyError: Its packages cannot be installed, or it imports an undeclared one.
        LoadError: The repository failed to load, or returned no environment.
        WorkerError: The worker did not come up, died, or took too long; or a server has no room
            (``ServerBusyError``).
        RuntimeError: ``sandbox=None`` without ``trust_remote_code=True``.
    """
    arguments = locals().copy()  # must come first, when only the arguments have names
    return _make(arguments.pop("cfg"), Options(**arguments))


def _make(cfg: Any, unchecked: Options) -> EnvSuites:
    reference, config = reference_of(cfg)
    options = unchecked.checked()
    if options.sandbox is None:
        return _make_here(reference, config, options)
    occupy_streams()  # before this opens any file or socket
    plan = _plan(options.sandbox, options)
    snapshot = snapshot_named(reference, **options.source)
    snapshot = with_assets(snapshot, options.assets, options.hub, plan.source.assets)
    target = plan.sandbox.package_target()
    while True:
        try:
            suites = _suites(snapshot, config, plan, options)
            break
        except DependencyError as error:
            if error.reason != "module" or not plan.source.note(snapshot, target, str(error)):
                raise
    return for_lerobot(suites) if options.trust_remote_code else suites


def _suites(snapshot: Snapshot, config: Any, plan: _Plan, options: Options) -> EnvSuites:
    """Make the environments of a snapshot. Raises ``DependencyError``."""
    target, gpu = plan.sandbox.package_target(), bool(plan.policy.gpu)
    packages = plan.source.packages(snapshot, target, gpu=gpu)
    load = m.Load(
        n_envs=options.n_envs,
        use_async_envs=options.use_async_envs,
        cfg=None if config is None else plain_config(config),
        env_kwargs=dict(options.env_kwargs or {}),
    )
    recipe = Recipe(
        make_env=make_env,  # a pickle makes the environments again by its name
        reference=snapshot.reference,
        config=load.cfg,
        options=options.for_a_recipe(
            env_kwargs=load.env_kwargs,
            assets=tuple(asset.pinned for asset in snapshot.assets),
            policy=plan.policy,
            timeouts=plan.timeouts,
            python=plan.source.python,
            dependencies="auto" if plan.source.python is not None else options.dependencies,
        ),
    )

    repository = Repository(
        snapshot,
        load,
        plan.policy,
        plan.timeouts,
        Runtime(packages.python, packages.packages) if packages else plan.runtime,
        options.copy,
        min_ready=options.min_ready,
        recipe=recipe,
        installed=packages.facts if packages else None,
        advice=partial(plan.source.advice, snapshot, plan.sandbox.name, packages is not None),
        of_its_day=partial(plan.source.of_its_day, snapshot, target),
    )
    prewarm = plan.policy.prewarm
    if prewarm is None and (options.sandbox != "process" or plan.policy.gpu):
        prewarm = 0  # it would use a shared resource: a container's memory, a key's quota, a GPU
    return EnvFactory(
        _launchers(repository, plan.sandbox, options),
        options.num_workers,
        prewarm,
        partial(plan.source.check, label=snapshot.label, env_kwargs=load.env_kwargs, config=config),
    ).make()


def _launchers(repository: Repository, sandbox: Sandbox, options: Options) -> list[Launcher]:
    """A launcher for each worker with a jail of its own."""
    store, apart = cache_root() / "snapshots", options.min_ready is not None
    count = options.num_workers or (options.n_envs if apart else None)
    launchers = [Launcher(repository, seat, store) for seat in sandbox.workers(count)]
    if apart and len(launchers) == 1 and count is not None:
        launchers += [launchers[0].another() for _ in range(1, count)]
    return launchers


@dataclass(frozen=True)
class _Plan:
    """The checked arguments, before anything is fetched or started."""

    sandbox: Sandbox
    policy: Policy
    timeouts: Timeouts
    source: PackageSource
    runtime: Runtime


def _plan(sandbox: str | Sandbox, options: Options) -> _Plan:
    source = source_of(options)
    policy = policy_from(options.policy, options.limits)
    timeouts = timeouts_from(options.timeouts)
    chosen = sandbox_of(sandbox)
    if source.always and chosen.package_target() is None:
        raise PolicyError(
            f"packages by {option_name('dependencies')} are for this machine, for containers and "
            "for servers on other hosts; this place has packages of its own"
        )
    runtime = Runtime(interpreter(source.python))
    chosen.note_interpreter(runtime)
    if chosen.is_here:
        program = runtime.python
        if program and not (os.path.isfile(program) and os.access(program, os.X_OK)):
            raise PolicyError(
                f"{option_name('python')} is {program!r}, which is not a program; it takes the "
                "path of an interpreter, such as '.venv/bin/python'; a version is chosen by "
                f"{option_name('dependencies', {'python': '3.12'})}"
            )
        check_readable(policy.readable)
    return _Plan(chosen, policy, timeouts, source, runtime)


def _make_here(reference: str, config: Any, options: Options) -> EnvSuites:
    """Make the environments in this process, without a sandbox, as LeRobot does."""
    if not options.trust_remote_code:
        raise inprocess.refusal(reference)
    options.refuse_sandboxed()
    snapshot = snapshot_named(reference, **options.source)
    further = dict(options.env_kwargs or {})
    envs = inprocess.make(snapshot, options.n_envs, options.use_async_envs, config, further)
    return EnvSuites(envs, partial(provenance_of, snapshot, None, []))


# --- reading arguments


def reference_of(cfg: Any) -> tuple[str, Any]:
    """The reference in ``cfg``, and ``cfg`` itself if it is a config object, else None."""
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


def sandbox_of(sandbox: str | Sandbox | list[str | Sandbox]) -> Sandbox:
    """The sandbox of a name; a sandbox unchanged; for a list, a fleet of its members.
    Raises ``PolicyError``: no sandbox has that name; ``SandboxUnavailableError``: this platform or
    installation lacks it.
    """
    fleet: Any = sandbox
    result: Sandbox
    if isinstance(sandbox, (list, tuple)) or (isinstance(sandbox, str) and is_list(sandbox)):
        fleet = _extra("fleet.fleet", "Fleet")(sandbox)
    if callable(getattr(fleet, "opened", None)):
        result = fleet.opened(sandbox_of)
    elif not isinstance(sandbox, str):
        if isinstance(sandbox, list) or not callable(getattr(sandbox, "for_repository", None)):
            raise _unknown(sandbox)
        result = sandbox
    elif sandbox.startswith("tcp://"):
        result = _extra("remote.sandbox", "RemoteSandbox")(sandbox)
    elif sandbox == "process":
        from envhub_sandbox.sandboxes.process import PROCESS, check_platform

        check_platform()  # before anything is downloaded for it
        result = PROCESS
    elif sandbox == "ray":
        result = _extra("ray.sandbox", "RAY")
    elif sandbox.partition(":")[0] == "docker":
        image = sandbox.partition(":")[2]
        result = _extra("docker.sandbox", "DockerSandbox")(**{"image": image} if image else {})
    else:
        raise _unknown(sandbox)
    return result


def _extra(module: str, name: str) -> Any:
    """A sandbox class of an extra. Raises ``SandboxUnavailableError``: the extra is missing."""
    instead = f"use {option_name('sandbox', 'process')}"
    return extras.required(f"envhub_sandbox.extras.{module}", name, option_name("sandbox"), instead)


def _unknown(sandbox: object) -> PolicyError:
    return PolicyError(
        f"sandbox is {sandbox!r}; it takes 'process', 'docker', 'ray', 'tcp://HOST:PORT KEY', "
        "a list of these, or None to run the code here"
    )


def interpreter(python: str | Path | None) -> str:
    """An interpreter's absolute path; looks up a name as a shell does. Empty for ours."""
    if python is None:
        return ""
    text = os.path.expanduser(python)
    program = shutil.which(text) if os.sep not in str(text) else None
    return os.path.abspath(program or text)


def check_readable(paths: Iterable[str]) -> None:
    """Raise ``PolicyError`` if a readable path does not exist on this machine."""
    for path in paths:
        if not os.path.exists(path):
            raise PolicyError(
                f"{option_name('readable')} has {path!r}, and there is no such file or folder on "
                "this machine"
            )
