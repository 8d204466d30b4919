"""Makes the packages that a repository runs with, by the same steps for every place.

The steps: read the request (``request_of``), use the place's own packages if they meet it, choose
versions (``resolution_for``), make an environment. A ``PackageTarget`` holds the differences
between this machine, a container and a server on another host. A lock file replaces the choice: its
packages are used exactly, and drift is an error.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

from envhub_sandbox.errors import DependencyError, LockError, PolicyError, name_source
from envhub_sandbox.extras.packages.request import Choice, PackageRequest, Tell, request_of
from envhub_sandbox.hub.reference import PYPI
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system import log
from envhub_sandbox.system.log import DEPENDENCIES, warn_caller
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.text import size_text

if TYPE_CHECKING:
    from envhub_sandbox.extras.packages.environments import Environment
    from envhub_sandbox.extras.packages.interpreters import Interpreter
    from envhub_sandbox.extras.packages.locks.lockfile import LockFile
    from envhub_sandbox.extras.packages.resolution.pylock import Lock
    from envhub_worker.protocol.manifest.manifest import Manifest

_CHECK_REFERENCE = (
    "The reference names the package: is it spelt so, and has the index that version?"
)


@dataclass(frozen=True)
class PackageSet:
    """Packages that were made for a repository.

    Attributes:
        packages: Their folder, or their name in their place.
        facts: Their description as plain data.
        python: The interpreter that they are for; empty if only the place knows it.
        environment: The record of the folder, if it is on this machine.
    """

    packages: str
    facts: dict[str, Any]
    python: str = ""
    environment: Environment | None = None

    @classmethod
    def of(cls, made: Environment) -> PackageSet:
        """Describes an environment of this machine."""
        return cls(str(made.packages), made.facts, made.python, made)


class PackageTarget(Protocol):
    """A place that runs a repository: this machine, a container or a server."""

    def meets(self, request: PackageRequest) -> bool:
        """Tells whether the place's own packages meet the request."""

    def make(self, request: PackageRequest, tell: Tell) -> PackageSet | None:
        """Makes separate packages; None if the place decides that its own packages suffice."""


@dataclass(frozen=True)
class ThisMachine:
    """This machine's interpreters; ``upgrade`` chooses versions again."""

    upgrade: bool = False

    def meets(self, request: PackageRequest) -> bool:
        """Tells whether this process's interpreter meets the whole request."""
        from envhub_sandbox.extras.packages import interpreters, modules

        met = interpreters.first_unmet(request) is None
        return met and all(map(modules.is_here, request.guesses))

    def make(self, request: PackageRequest, tell: Tell) -> PackageSet:
        """Makes an environment; raises as ``resolution_for`` and ``environments.provide``."""
        from envhub_sandbox.extras.packages import environments
        from envhub_sandbox.extras.packages.resolution import resolutions

        resolution = resolutions.resolution_for(request, tell, upgrade=self.upgrade)
        if resolution.lock.has_cuda and not request.gpu:
            _warn_of_cuda(resolution.lock, resolution.interpreter)
        packages = PackageSet.of(
            environments.provide(resolution.lock, resolution.interpreter, tell)
        )
        inferred = [guess.facts for guess in request.guesses if guess.module in resolution.taken]
        return (
            replace(packages, facts=packages.facts | {"inferred": inferred})
            if inferred
            else packages
        )


def _warn_of_cuda(lock: Lock, interpreter: Interpreter) -> None:
    """Announce large downloads for CUDA before they begin, and the setting that avoids them."""
    from envhub_sandbox.extras.packages import environments

    if environments.ready(environments.key_of(lock, interpreter)) is not None:
        return
    size = sum(max(wheel.size or 0 for wheel in package.wheels) for package in lock.pinned)
    much = f" ({size_text(size)} of downloads)" if size else ""
    warn_caller(
        f"PyTorch comes with CUDA{much}, and jails have no GPU here: the index has no build "
        "without. UV_TORCH_BACKEND=cpu in the environment takes PyTorch's own, by its index; "
        f"{option_name('policy', {'gpu': True})} gives jails a GPU",
    )


HERE = ThisMachine()


def packages_for(
    snapshot: Snapshot, choice: Choice, target: PackageTarget = HERE, *, gpu: bool = False
) -> PackageSet | None:
    """Returns the packages that a repository runs with; None if it uses the place's own.

    Shows progress on a terminal. Raises ``DependencyError``, with what to change.
    """
    from envhub_sandbox.extras.packages.locks.day import settled

    try:
        request = request_of(snapshot, settled(snapshot, choice), gpu=gpu)
        if request is None or (not request.always and target.meets(request)):
            return None
        with log.progress_shown("packages") as tell:
            try:
                return target.make(request, tell)
            except DependencyError as error:
                unavailable = error.reason in ("resolution", "index")
                if request.wanted or request.always or not unavailable:
                    raise
                # imports are not declarations: the repository may run without these packages
                DEPENDENCIES.warning("%s: nothing is installed for it: %s", snapshot.label, error)
                return None
    except DependencyError as error:
        if snapshot.repo_type == PYPI and _is_unknown(snapshot.repo_id, error):
            error.args = (f"{error}\n{_CHECK_REFERENCE}", *error.args[1:])
        name_source(error, snapshot.label)
        raise


def _is_unknown(repo_id: str, error: DependencyError) -> bool:
    """Tells whether the index lacks the package, or the version, that a reference names."""
    from envhub_sandbox.extras.packages.modules import canonical

    name = re.escape(canonical(re.split(r"[\[#@]", repo_id)[0]))
    pattern = rf"no version of {name}\b|\b{name} was not found"
    return error.reason == "resolution" and re.search(pattern, str(error)) is not None


def opened_lock(
    path: str | os.PathLike[str], sandbox: object, python: object, dependencies: object
) -> LockFile:
    """Reads the lock of ``make_env``; ``PolicyError`` if other arguments contradict it."""
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
    from envhub_sandbox.extras.packages.locks import lockfile

    return lockfile.read(path)


def locked_packages(snapshot: Snapshot, lock: LockFile) -> PackageSet:
    """Returns the environment of a lock's packages; makes it if needed.

    Raises ``LockDriftError`` if the files or the interpreter differ from the lock.
    """
    from envhub_sandbox.extras.packages import environments, interpreters
    from envhub_sandbox.extras.packages.locks import lockfile, making
    from envhub_sandbox.extras.packages.resolution import resolve

    state = making.with_files(lock, snapshot)
    making.refuse(making.differences(lock, state), snapshot.label)
    try:
        interpreter = interpreters.find(lock.runner.python)
        state = replace(state, runner=lockfile.Runner.of(interpreter))
        making.refuse(making.differences(lock, state), snapshot.label)
        with log.progress_shown("packages") as tell:
            pins = _with_wheels(resolve.pins(lock.packages), interpreter, tell)
            environment = environments.provide(pins, interpreter, tell)
            return PackageSet.of(environment)
    except (DependencyError, LockError) as error:
        name_source(error, snapshot.label)
        raise


def _with_wheels(lock: Lock, interpreter: Interpreter, tell: Tell) -> Lock:
    """Adds wheels for packages without one to a lock: kept wheels, or new builds of locked sources.
    Raises ``DependencyError`` if a build fails or a source has changed.
    """
    from envhub_sandbox.extras.packages import environments
    from envhub_sandbox.extras.packages.builds.wheels import describe
    from envhub_sandbox.extras.packages.resolution.pylock import Lock
    from envhub_sandbox.extras.packages.resolution.resolutions import build

    locked = [package.origin for package in lock.pinned if package.origin is not None]
    if not locked or environments.ready(environments.key_of(lock, interpreter)) is not None:
        return lock
    wheels = build([origin.source for origin in locked], interpreter, tell)
    built, options = {}, list(lock.options)
    for origin, wheel in zip(locked, wheels, strict=True):
        built[origin.source.name] = here = describe(wheel)
        assert here is not None
        if here.wheel != origin.wheel:
            tell(f"{origin.source.name} was built again, and not to the same bytes")
        options += ["--find-links", str(wheel.parent)]
    pinned = (replace(package, origin=built.get(package.name)) for package in lock.pinned)
    return Lock(tuple(pinned), tuple(options))


def check_locked_tasks(
    manifest: Manifest, lock: LockFile, label: str, env_kwargs: Mapping[str, Any]
) -> None:
    """Raise ``LockDriftError`` if a manifest's environments differ from the locked ones.

    Skips the comparison for other arguments, which may make other environments.
    """
    from envhub_sandbox.extras.packages.locks import lockfile, making

    if lock.spaces is None or lockfile.arguments_text(env_kwargs) != lock.spaces.arguments:
        return
    now = [
        making.fingerprint_of_task(
            *(env.suite, env.task, env.autoreset_mode),
            *(env.single_observation_space, env.single_action_space),
        )
        for env in manifest.envs
    ]
    making.refuse(list(making.drift_of_tasks(lock.spaces.tasks, now)), label)
