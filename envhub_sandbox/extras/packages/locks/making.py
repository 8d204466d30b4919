"""Makes lock files of the present state, and lists differences from a lock: drift."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from envhub_sandbox.errors import LockDriftError
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.builds.wheels import describe
from envhub_sandbox.extras.packages.declared import WantedPackage, parse_requirement
from envhub_sandbox.extras.packages.locks.day import settled
from envhub_sandbox.extras.packages.locks.lockfile import (
    LOCAL,
    LockFile,
    Runner,
    TaskFingerprint,
)
from envhub_sandbox.extras.packages.request import Choice, PackageRequest, request_of
from envhub_sandbox.extras.packages.resolution import resolve
from envhub_sandbox.extras.packages.resolution.pylock import Lock, PylockPackage
from envhub_sandbox.extras.packages.resolution.resolutions import resolution_for
from envhub_sandbox.extras.packages.resolution.resolve import Target
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_worker.protocol.spaces.spaces import encode_space
from envhub_worker.protocol.text import first_of, printable

_SHOWN = 30
_TEXT = 200


def differences(then: LockFile, now: LockFile) -> list[str]:
    """Lists all differences, a line each."""
    runner = f"Python: {then.runner} was locked, this is {now.runner}"
    spaces: Iterator[str] = iter(())
    if then.spaces and now.spaces and then.spaces.arguments == now.spaces.arguments:
        spaces = drift_of_tasks(then.spaces.tasks, now.spaces.tasks)
    return [
        *_of_files(then, now),
        *([runner] if then.runner != now.runner else []),
        *_of_packages(then.packages, now.packages),
        *spaces,
    ]


def refuse(found: Sequence[str], label: str) -> None:
    """Raise ``LockDriftError`` if there are differences."""
    if not found:
        return
    lines = "\n".join(f"  {line}" for line in first_of(found, _SHOWN))
    raise LockDriftError(
        f"{label}: differs from its lock:\n{lines}\nUse what was locked, or lock the present "
        "state: envhub lock --upgrade REF",
        tuple(found),
    )


def with_files(lock: LockFile, snapshot: Snapshot) -> LockFile:
    """Returns the lock with the files of a snapshot."""
    return replace(
        lock,
        repository=LOCAL if snapshot.is_local else snapshot.name,
        commit=snapshot.commit,
        entry=snapshot.path,
        files={record.path: record.digest for record in snapshot.files},
        assets=tuple(asset.pinned for asset in snapshot.assets),
    )


def _of_files(then: LockFile, now: LockFile) -> Iterator[str]:
    if then.repository != now.repository:
        both = (then.repository, now.repository)
        names = ["a local folder" if repository == LOCAL else repository for repository in both]
        yield f"repository: {names[0]} was locked, this is {names[1]}"
    if then.commit != now.commit:
        yield f"commit: {then.commit[:18]} was locked, this is {now.commit[:18]}"
    if then.entry != now.entry:
        yield f"entry file: {then.entry} was locked, this is {now.entry}"
    if set(then.assets) != set(now.assets):
        old, new = (", ".join(sorted(lock.assets)) or "none" for lock in (then, now))
        yield f"assets: {printable(old, 2000)} were locked, these are {printable(new, 2000)}"
    for name in sorted({*then.files, *now.files}):
        shown = printable(name, 200)
        if name not in now.files:
            yield f"file {shown}: gone"
        elif name not in then.files:
            yield f"file {shown}: new"
        elif then.files[name] != now.files[name]:
            yield f"file {shown}: other content"


def _of_packages(then: Sequence[PylockPackage], now: Sequence[PylockPackage]) -> Iterator[str]:
    before, after = ({package.name: package for package in packages} for packages in (then, now))
    for name in sorted({*before, *after}):
        old, new = before.get(name), after.get(name)
        if old is None and new is not None:
            yield f"package {name}: new, {new.version}"
        elif new is None and old is not None:
            yield f"package {name}: gone, {old.version} was locked"
        elif old is not None and new is not None:
            yield from _of_package(old, new)


def _of_package(then: PylockPackage, now: PylockPackage) -> Iterator[str]:
    if then.version != now.version:
        yield f"package {then.name}: {then.version} was locked, this is {now.version}"
        return
    before, after = (
        package.origin.source.identity if package.origin else "" for package in (then, now)
    )
    if before != after:
        yield f"package {then.name}: built of {before or 'no source'}, this of {after or 'none'}"
    hashes = {wheel.sha256 for wheel in now.wheels}
    for wheel in then.wheels:
        if wheel.sha256 not in hashes:
            others = ", ".join(sorted(digest[:12] for digest in hashes)) or "none"
            yield (
                f"package {then.name}=={then.version}: the file with SHA-256 "
                f"{wheel.sha256[:12]}... was locked, there is {others}"
            )


def drift_of_tasks(
    then: Sequence[TaskFingerprint], now: Sequence[TaskFingerprint]
) -> Iterator[str]:
    """Yields the differences between environments."""
    before, after = ({task.name: task for task in tasks} for tasks in (then, now))
    for name in sorted({*before, *after}):
        old, new, shown = before.get(name), after.get(name), printable(name, 200)
        if old is None or new is None:
            yield f"environment {shown}: {'new' if old is None else 'gone'}"
            continue
        if old.mode != new.mode:
            yield f"environment {shown}: autoreset mode {old.mode or 'none'}, now {new.mode}"
        if old.spaces != new.spaces:
            drifts = [
                f"{field} were {before}, now {after}"
                for field, before, after in (
                    ("observations", old.observations, new.observations),
                    ("actions", old.actions, new.actions),
                )
                if before != after
            ]
            text = "; ".join(drifts) or "other bounds or types in its spaces, which read the same"
            yield f"environment {shown}: {text}"


def locked(snapshot: Snapshot, choice: Choice, *, upgrade: bool = False) -> LockFile:
    """Locks a repository with the packages of a choice; runs neither of them."""
    request = request_of(snapshot, replace(settled(snapshot, choice), where="own"))
    assert request is not None  # only ``where="host"`` gives None
    resolution = resolution_for(request, upgrade=upgrade)
    empty = LockFile(
        *("", "", "", {}, Runner.of(resolution.interpreter)),
        packages=_with_origins(resolution.lock),
        extra=tuple(map(str, choice.extra)),
        only=None if choice.only is None else tuple(map(str, choice.only)),
        override=tuple(map(str, choice.override)),
        without=choice.without,
        inferred=tuple(
            f"{guess.wanted.requirement} ({guess.wanted.where})"
            for guess in request.guesses
            if guess.module in resolution.taken
        ),
        exclude_newer=request.exclude_newer,
    )
    return with_files(empty, snapshot)


def _with_origins(lock: Lock) -> tuple[PylockPackage, ...]:
    """Returns the packages; those that were built here with their sources in place of wheels."""
    folders = [Path(option) for option in lock.options if option.startswith("/")]
    wheels = [wheel for folder in folders for wheel in folder.glob("*.whl")]
    origins = {origin.wheel: origin for origin in map(describe, wheels) if origin is not None}
    packages = []
    for package in lock.pinned:
        built = [origins[wheel.sha256] for wheel in package.wheels if wheel.sha256 in origins]
        packages.append(replace(package, wheels=(), origin=built[0]) if built else package)
    return tuple(packages)


def again(lock: LockFile) -> Choice:
    """Returns the choice that led to a lock."""
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
    """Returns the lock with the files that the index has for its packages now."""
    built = [package for package in lock.packages if package.origin is not None]
    pins = [
        f"{package.name}=={package.version}" for package in lock.packages if package.origin is None
    ]
    request = PackageRequest("the lock", _parsed(pins), runs_worker=False)
    target = Target(python=interpreters.find(lock.runner.python).path)
    options = (*resolve.pins(lock.packages).options, "--no-deps")
    listed = resolve.resolve(request, target, options=options, refresh=True).pinned
    return replace(lock, packages=tuple(sorted((*built, *listed), key=attrgetter("name"))))


def tasks_of(suites: Mapping[str, Mapping[Any, Any]]) -> tuple[TaskFingerprint, ...]:
    """Describes the environments that ``make_env`` returned, in a comparable form."""
    fingerprints = []
    for suite, tasks in suites.items():
        for task, env in tasks.items():
            mode = env.metadata.get("autoreset_mode")
            spaces = env.single_observation_space, env.single_action_space
            fingerprints.append(
                fingerprint_of_task(suite, task, getattr(mode, "value", mode), *spaces)
            )
    return tuple(fingerprints)


def fingerprint_of_task(
    suite: str,
    task: int | str,
    mode: str | None,
    observations: gym.Space[Any],
    actions: gym.Space[Any],
) -> TaskFingerprint:
    """Describes one environment for a lock. Trust: input from the worker, already checked."""
    spaces = fingerprint_of_spaces(observations, actions)
    texts = (" ".join(str(space).split()) for space in (observations, actions))
    seen, done = (printable(text, _TEXT).replace("\n", " ") for text in texts)
    return TaskFingerprint(suite, task, mode or "", seen, done, spaces)


def fingerprint_of_spaces(*spaces: gym.Space[Any]) -> str:
    """Hashes the kinds, shapes, dtypes and bounds of spaces, without the state of generators."""
    digest = hashlib.sha256()
    for space in spaces:
        _add(digest, encode_space(space))
    return f"sha256:{digest.hexdigest()}"


def _add(digest: Any, value: object) -> None:
    """Hash a value after its kind and length, so that different values never read alike."""
    if isinstance(value, dict):
        if value.get("kind") == "opaque":  # its text may hold an address
            value = {name: item for name, item in value.items() if name != "text"}
        digest.update(f"dict {len(value)};".encode())
        for key, item in value.items():  # the order of a Dict space is part of it
            _add(digest, key)
            _add(digest, item)
    elif isinstance(value, (list, tuple)):
        digest.update(f"list {len(value)};".encode())
        for item in value:
            _add(digest, item)
    elif isinstance(value, (np.ndarray, np.generic)):
        array = np.ascontiguousarray(value)
        plain = array.astype(array.dtype.newbyteorder("<"), copy=False)
        digest.update(f"array {plain.dtype.str} {np.shape(value)};".encode() + plain.tobytes())
    else:
        data = repr(value).encode("utf-8", "backslashreplace")
        digest.update(f"{type(value).__name__} {len(data)};".encode() + data)
