"""A lock file as ``make_env`` uses it: its packages and no others, and nothing that has drifted."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from envhub_sandbox.errors import DependencyError, LockError, PolicyError, name_source
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.settings.options import option_name

if TYPE_CHECKING:  # they cost time, and mostly there is no lock
    from envhub_sandbox.dependencies.builds.sources import WheelOrigin
    from envhub_sandbox.dependencies.interpreters import Interpreter
    from envhub_sandbox.dependencies.locks.lockfile import LockFile
    from envhub_sandbox.dependencies.packages import PackageSet
    from envhub_sandbox.dependencies.resolve import Lock
    from envhub_worker.protocol.manifest.manifest import Manifest


def opened(
    path: str | os.PathLike[str], sandbox: object, python: object, dependencies: object
) -> LockFile:
    """The lock of these arguments of ``make_env``; ``PolicyError`` if the others say something
    else.
    """
    if python is not None or dependencies != "auto":
        raise PolicyError(
            f"{option_name('lock')} has the packages already; leave out {option_name('python')} "
            f"and {option_name('dependencies')}"
        )
    if sandbox != "process":
        raise PolicyError(
            f"{option_name('lock')} is for {option_name('sandbox', 'process')}; an image is locked "
            "by its digest, and on another host the operator of the server chooses its packages"
        )
    from envhub_sandbox.dependencies.locks import lockfile

    return lockfile.read(path)


def provided(snapshot: Snapshot, lock: LockFile) -> PackageSet:
    """The environment of its packages; made if there is none.

    Raises ``LockDriftError`` where the files or the interpreter are others.
    """
    from envhub_sandbox.dependencies import environments, interpreters
    from envhub_sandbox.dependencies.locks import drift, lockfile, pylock
    from envhub_sandbox.dependencies.packages import PackageSet
    from envhub_sandbox.system import progress

    here = drift.with_files(lock, snapshot)
    drift.refuse(drift.differences(lock, here), snapshot.label)
    try:
        interpreter = interpreters.find(lock.runner.python)
        here = replace(here, runner=lockfile.Runner.of(interpreter))
        drift.refuse(drift.differences(lock, here), snapshot.label)
        with progress.progress_shown("packages") as tell:
            locked = [one.origin for one in lock.packages if one.origin is not None]
            pins = _with_wheels(pylock.pins(lock.packages), locked, interpreter, tell)
            made = environments.provide(pins, interpreter, tell)
            return PackageSet.of(made)
    except (DependencyError, LockError) as error:
        name_source(error, snapshot.label)
        raise


def _with_wheels(
    lock: Lock,
    locked: Sequence[WheelOrigin],
    interpreter: Interpreter,
    tell: Callable[[str], None],
) -> Lock:
    """The lock with wheels of what has none: kept, or built again of the locked sources.
    Raises ``DependencyError`` where one cannot be built, or its source is another.
    """
    from envhub_sandbox.dependencies import environments
    from envhub_sandbox.dependencies.builds import wheel_store
    from envhub_sandbox.dependencies.resolutions import build
    from envhub_sandbox.dependencies.resolve import Lock

    if not locked or environments.ready(environments.key_of(lock, interpreter)) is not None:
        return lock
    wheels = build([one.source for one in locked], interpreter, tell)
    text, options = lock.text, list(lock.options)
    for origin, wheel in zip(locked, wheels, strict=True):
        built = wheel_store.describe(wheel)
        assert built is not None
        if built.wheel != origin.wheel:
            tell(f"{origin.source.name} was built again, and not to the same bytes")
        text = text.replace(f"sha256:{origin.wheel}", f"sha256:{built.wheel}")
        options += ["--find-links", str(wheel.parent)]
    return Lock(text, tuple(options))


def checker(
    lock: LockFile | None, label: str, env_kwargs: Mapping[str, Any], config: object
) -> Callable[[Manifest], None]:
    """What holds a manifest against the lock.

    With other arguments than those that were locked a repository may well make other environments:
    then there is nothing to hold it against.
    """

    def check(manifest: Manifest) -> None:
        if lock is None or lock.spaces is None or config is not None:
            return
        from envhub_sandbox.dependencies.locks import drift, lockfile
        from envhub_sandbox.dependencies.locks.fingerprint import fingerprint_of_task

        if lockfile.arguments_text(env_kwargs) == lock.spaces.arguments:
            now = [
                fingerprint_of_task(
                    *(env.suite, env.task, env.autoreset_mode),
                    *(env.single_observation_space, env.single_action_space),
                )
                for env in manifest.envs
            ]
            drift.refuse(list(drift.drift_of_tasks(lock.spaces.tasks, now)), label)

    return check
