"""From a reference to environments: snapshot, packages, sandbox, proxies."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from envhub_sandbox.dependencies.modules import MissingModule
from envhub_sandbox.dependencies.packages import (
    PackageSet,
    lock_checker,
    locked_packages,
    opened_lock,
    packages_for,
)
from envhub_sandbox.dependencies.request import Choice, chosen
from envhub_sandbox.errors import PolicyError
from envhub_sandbox.factory import sandbox_spec
from envhub_sandbox.factory.config import plain_config, reference_of
from envhub_sandbox.factory.env_factory import EnvFactory
from envhub_sandbox.hub.snapshot import Snapshot, snapshot_named
from envhub_sandbox.hub.sources.assets import with_assets
from envhub_sandbox.sandboxes import inprocess
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.session.jails.launcher import Launcher
from envhub_sandbox.session.recipe import Recipe, provenance_of
from envhub_sandbox.session.repository import LoadArguments, Repository
from envhub_sandbox.settings.options import Options, option_name
from envhub_sandbox.settings.policy import Policy, Timeouts, policy_from, timeouts_from
from envhub_sandbox.system import processes
from envhub_sandbox.system.folders import cache_root
from envhub_sandbox.vector.suites import EnvSuites
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.runtime import Runtime

if TYPE_CHECKING:
    from envhub_sandbox.dependencies.locks.lockfile import LockFile


def make(make_env: Callable[..., EnvSuites], cfg: Any, given: Options) -> EnvSuites:
    """What ``make_env`` does; returns and raises as it does.

    Args:
        make_env: The function itself, by whose name a pickle makes the environments again.
        cfg: Its first argument.
        given: The others.
    """
    reference, config = reference_of(cfg)
    options = given.checked()
    if options.sandbox is None:
        return _make_here(reference, config, options)
    processes.occupy_streams()  # before anything of ours is opened
    wanted = _wanted(options.sandbox, options)
    snapshot = snapshot_named(reference, **options.hub)
    locked = wanted.lock.assets if wanted.lock is not None else ()
    snapshot = with_assets(snapshot, options.assets or locked, options.hub)
    packages = _packages(snapshot, wanted)
    load = LoadArguments(
        n_envs=options.n_envs,
        use_async_envs=options.use_async_envs,
        cfg=None if config is None else plain_config(config),
        env_kwargs=dict(options.env_kwargs or {}),
    )
    recipe = Recipe(
        make_env=make_env,
        reference=snapshot.reference,
        config=load.cfg,
        options=options.for_a_recipe(
            env_kwargs=load.env_kwargs,
            assets=tuple(one.pinned for one in snapshot.assets),
            policy=wanted.policy,
            timeouts=wanted.timeouts,
            python=wanted.python,
            dependencies="auto" if wanted.python is not None else options.dependencies,
        ),
    )
    own = packages is not None
    repository = Repository(
        snapshot,
        load,
        wanted.policy,
        wanted.timeouts,
        Runtime(packages.python, packages.packages) if packages else wanted.runtime,
        options.lane,
        options.copy,
        min_ready=options.min_ready,
        recipe=recipe,
        installed=packages.facts if packages else None,
        advice=MissingModule(
            snapshot, wanted.place.name, wanted.choice.where, wanted.python, own
        ).advice,
    )
    return EnvFactory(
        _launchers(repository, wanted.place, options),
        options.num_workers,
        _ahead(wanted, options),
        _face(options.validate),
        lock_checker(wanted.lock, snapshot.label, load.env_kwargs, config),
    ).make()


def _launchers(repository: Repository, place: Sandbox, options: Options) -> list[Launcher]:
    """One for each worker with a jail of its own."""
    store, apart = cache_root() / "snapshots", options.min_ready is not None
    count = options.num_workers or (options.n_envs if apart else None)
    found = [Launcher(repository, one, store) for one in place.workers(count)]
    if apart and len(found) == 1 and count is not None:
        found += [found[0].another() for _ in range(1, count)]
    return found


@dataclass(frozen=True)
class _Plan:
    """What was asked for, looked at before anything is fetched or started."""

    place: Sandbox
    policy: Policy
    timeouts: Timeouts
    choice: Choice
    python: Any
    runtime: Runtime
    lock: LockFile | None


def _wanted(sandbox: str | Sandbox, options: Options) -> _Plan:
    lock = None
    if options.lock is not None:
        lock = opened_lock(options.lock, sandbox, options.python, options.dependencies)
    choice, python = chosen(options.dependencies, options.python)
    policy = policy_from(options.policy, options.limits)
    timeouts = timeouts_from(options.timeouts)
    place = sandbox_spec.sandbox_of(sandbox, options.server_key)
    if choice.where == "own" and place.package_target() is None:
        raise PolicyError(
            f"packages by {option_name('dependencies')} are for this machine, for containers and "
            "for servers on other hosts; this place has packages of its own"
        )
    runtime = Runtime(sandbox_spec.interpreter(python))
    place.note_interpreter(runtime)
    if place.is_here:
        sandbox_spec.check_executable(runtime.python)
        sandbox_spec.check_readable(policy.readable)
    return _Plan(place, policy, timeouts, choice, python, runtime, lock)


def _make_here(reference: str, config: Any, options: Options) -> EnvSuites:
    """In this process, without a sandbox, as LeRobot does."""
    if not options.trust_remote_code:
        raise inprocess.refusal(reference)
    options.refuse_sandboxed()
    snapshot = snapshot_named(reference, **options.hub)
    further = dict(options.env_kwargs or {})
    envs = inprocess.make(snapshot, options.n_envs, options.use_async_envs, config, further)
    return EnvSuites(envs, lambda: provenance_of(snapshot, None, []))


def _packages(snapshot: Snapshot, wanted: _Plan) -> PackageSet | None:
    """The packages that are made for it; None for those of the place."""
    if wanted.lock is not None:
        return locked_packages(snapshot, wanted.lock)
    target = wanted.place.package_target()
    if target is None:
        return None
    return packages_for(snapshot, wanted.choice, target, gpu=bool(wanted.policy.gpu))


def _ahead(wanted: _Plan, options: Options) -> int | None:
    """How many tasks are started ahead, unasked none where it is not ours alone to say.

    A container's memory is all its jails', a quota is all a key's, and a GPU everybody's.
    """
    if options.prewarm is None and (options.sandbox != "process" or wanted.policy.gpu):
        return 0
    return options.prewarm


def _face(validate: bool) -> type[SandboxVectorEnv]:
    if not validate:
        return SandboxVectorEnv
    from envhub_sandbox.vector.validated import ValidatedVectorEnv

    return ValidatedVectorEnv
