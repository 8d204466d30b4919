"""Makes lock files: what is there now, as a lock file says it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from envhub_sandbox.dependencies import interpreters
from envhub_sandbox.dependencies.declared import WantedPackage, parse_requirement
from envhub_sandbox.dependencies.locks import lockfile, pylock
from envhub_sandbox.dependencies.locks.drift import with_files
from envhub_sandbox.dependencies.locks.fingerprint import TaskFingerprint, fingerprint_of_task
from envhub_sandbox.dependencies.locks.lockfile import LockFile, Runner, Spaces
from envhub_sandbox.dependencies.request import Choice, request_of
from envhub_sandbox.dependencies.resolutions import resolution_for
from envhub_sandbox.errors import LockError
from envhub_sandbox.hub.snapshot import Snapshot


def locked(
    snapshot: Snapshot,
    choice: Choice,
    tell: Callable[[str], None] = lambda line: None,
    *,
    upgrade: bool = False,
) -> LockFile:
    """A lock of a repository with the packages of a choice; nothing of either runs."""
    request = request_of(snapshot, replace(choice, where="own"))
    assert request is not None  # which only another choice gives
    found = resolution_for(request, tell, upgrade=upgrade)
    empty = LockFile(
        *("", "", "", {}, Runner.of(found.interpreter)),
        packages=pylock.described(found.lock, found.interpreter.path),
        extra=tuple(map(str, choice.extra)),
        only=None if choice.only is None else tuple(map(str, choice.only)),
        override=tuple(map(str, choice.override)),
        without=choice.without,
        inferred=tuple(
            f"{one.wanted.requirement} ({one.wanted.where})"
            for one in request.guesses
            if one.module in found.taken
        ),
        exclude_newer=choice.exclude_newer,
    )
    return with_files(empty, snapshot)


def again(lock: LockFile) -> Choice:
    """The choice that led to a lock."""
    return Choice(
        "own",
        _parsed(lock.extra),
        lock.runner.python,
        lock.exclude_newer,
        infer=lock.only is None,
        only=None if lock.only is None else _parsed(lock.only),
        without=lock.without,
        override=_parsed(lock.override),
    )


def _parsed(texts: Sequence[str]) -> tuple[WantedPackage, ...]:
    return tuple(parse_requirement(text, f"{text[:80]!r} in the lock") for text in texts)


def relisted(lock: LockFile) -> LockFile:
    """The same with the files that the index has of its packages now."""
    built = [one for one in lock.packages if one.origin is not None]
    pins = [f"{one.name}=={one.version}" for one in lock.packages if one.origin is None]
    interpreter = interpreters.find(lock.runner.python)
    options = pylock.pins(lock.packages).options
    found = pylock.listed(pins, interpreter.path, options, refresh=True)
    packages = tuple(sorted((*built, *found), key=lambda one: one.name))
    return replace(lock, packages=packages)


def with_spaces(
    lock: LockFile, env_kwargs: Mapping[str, Any], suites: Mapping[str, Mapping[Any, Any]]
) -> LockFile:
    """The same with what a repository's ``make_env`` returned for these arguments."""
    arguments = lockfile.arguments_text(env_kwargs)
    if arguments is None:
        raise LockError("env_kwargs have values that a lock cannot record")
    return replace(lock, spaces=Spaces(arguments, tasks_of(suites)))


def tasks_of(suites: Mapping[str, Mapping[Any, Any]]) -> tuple[TaskFingerprint, ...]:
    """What a repository's ``make_env`` returned, in a form that can be compared."""
    found = []
    for suite, tasks in suites.items():
        for task, env in tasks.items():
            mode = env.metadata.get("autoreset_mode")
            spaces = env.single_observation_space, env.single_action_space
            found.append(fingerprint_of_task(suite, task, getattr(mode, "value", mode), *spaces))
    return tuple(found)
