"""Lock files: ``pylock.<name>.toml``, with what is ours under ``[tool.envhub]``.

The file is the caller's own, but may have come with somebody's project: it is read as data within
bounds, and decides nothing but what it is about. See ``docs/dependencies.md``.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from envhub_sandbox.dependencies.declared import parse_requirement
from envhub_sandbox.dependencies.interpreters import Interpreter
from envhub_sandbox.dependencies.locks import pylock
from envhub_sandbox.dependencies.locks.fingerprint import TaskFingerprint
from envhub_sandbox.dependencies.locks.pylock import PylockPackage, quoted, table
from envhub_sandbox.dependencies.request import DATE
from envhub_sandbox.errors import LockError, RequirementError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.system.folders import write_whole_file

FORMAT = 1
MAX_FILES = 20_000
MAX_TASKS = 4096
MAX_TEXT = 4096
LOCAL = "local"
"""The repository of a folder of this machine, whose path means nothing elsewhere."""
_REQUIREMENTS = ("extra", "only", "override", "without")
_COMMIT = re.compile(r"[0-9a-f]{40}|(local|pypi)-[0-9a-f]+")
_PYTHON = re.compile(r"3\.\d{1,3}")
_WORD = re.compile(r"[a-z0-9_]{1,40}")
_DIGEST = re.compile(r"git-sha1:[0-9a-f]{40}|sha256:[0-9a-f]{64}")


@dataclass(frozen=True)
class Runner:
    """The kind of interpreter that packages were chosen for; its patch release may change."""

    implementation: str
    python: str
    machine: str

    def __str__(self) -> str:
        return f"{self.implementation} {self.python} on {self.machine}"

    @classmethod
    def of(cls, interpreter: Interpreter) -> Runner:
        """That of an interpreter which is here."""
        python = ".".join(interpreter.version.split(".")[:2])
        return cls(interpreter.implementation, python, interpreter.machine)


@dataclass(frozen=True)
class Spaces:
    """What a repository's ``make_env`` returned for arguments (as ``arguments_text`` writes)."""

    arguments: str
    tasks: tuple[TaskFingerprint, ...]


@dataclass(frozen=True)
class LockFile:
    """All that is locked.

    Attributes:
        repository: As a reference begins, such as ``"org/repo"``; or ``LOCAL``.
        commit: The full commit; of a folder its content's.
        runner: What the packages are for.
        extra: Requirements that the caller added.
        exclude_newer: The date before which versions were chosen, if there was one.
        spaces: What the environments looked like; None where nothing was run.
        only: Those that he gave instead of what is declared; None where that counts.
        override: Those that hold instead of all others of the same package.
        without: Packages that he left out.
        inferred: What was taken though nothing declares it, and where it is imported.
        assets: Further repositories that it may read, each at its commit.
    """

    repository: str
    commit: str
    entry: str
    files: Mapping[str, str]
    runner: Runner
    packages: tuple[PylockPackage, ...]
    extra: tuple[str, ...] = ()
    exclude_newer: str | None = None
    spaces: Spaces | None = None
    only: tuple[str, ...] | None = None
    override: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    inferred: tuple[str, ...] = ()
    assets: tuple[str, ...] = ()


def repository_of(snapshot: Snapshot) -> str:
    """As a lock file names it."""
    return LOCAL if snapshot.repo_type == "local" else snapshot.name


def reference_of(lock: LockFile) -> str | None:
    """The pinned reference; None for a folder, whose place is not known."""
    if lock.repository == LOCAL:
        return None
    if lock.commit.startswith("pypi-"):
        return lock.repository
    return f"{lock.repository}@{lock.commit}:{lock.entry}"


def arguments_text(env_kwargs: Mapping[str, Any] | None) -> str | None:
    """Arguments in a form that can be compared; None for what has none."""
    try:
        text = json.dumps(dict(env_kwargs or {}), sort_keys=True, allow_nan=False)
    except (TypeError, ValueError):
        return None
    return text if len(text) <= MAX_TEXT else None


def read(path: str | os.PathLike[str]) -> LockFile:
    """A lock file; ``LockError`` if it cannot be read, or is none of ours."""
    where = f"the lock {os.fspath(path)}"
    try:
        with open(path, "rb") as file:
            data = file.read(pylock.MAX_CHARACTERS + 1)
        text = data.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise LockError(f"{where} cannot be read: {error}. 'envhub lock REF' writes one") from error
    document = pylock.document(text, where)
    packages = pylock.read(document, where)
    if not packages:
        raise LockError(f"{where} has no packages")
    ours = table(table(document, "tool"), "envhub")
    if ours.get("format") != FORMAT:
        raise LockError(
            f"{where} has no [tool.envhub] of format {FORMAT}: it was written by another program, "
            "or by another release of this one. 'envhub lock REF' writes one"
        )
    return _Reader(where, ours).lock(packages)


class _Reader:
    """Reads ``[tool.envhub]``, field by field."""

    def __init__(self, where: str, ours: Mapping[str, Any]) -> None:
        self._where = where
        self._ours = ours

    def lock(self, packages: tuple[PylockPackage, ...]) -> LockFile:
        text = self._text
        newer = (
            text(self._ours, "exclude-newer", re.compile(DATE))
            if "exclude-newer" in self._ours
            else None
        )
        return LockFile(
            repository=text(self._ours, "repository"),
            commit=text(self._ours, "commit", _COMMIT),
            entry=text(self._ours, "entry"),
            files=self._files(),
            runner=Runner(
                text(self._ours, "implementation", _WORD),
                text(self._ours, "python", _PYTHON),
                text(self._ours, "machine", _WORD),
            ),
            packages=packages,
            inferred=self._texts("inferred"),
            assets=self._texts("assets"),
            exclude_newer=newer,
            spaces=self._spaces(),
            **{name: self._requirements(name) for name in _REQUIREMENTS if name in self._ours},
        )

    def _text(
        self, table: Mapping[str, Any], name: str, pattern: re.Pattern[str] | None = None
    ) -> str:
        value = table.get(name)
        if not isinstance(value, str) or not value.isprintable() or len(value) > MAX_TEXT:
            raise self._wrong(name)
        if pattern is not None and not pattern.fullmatch(value):
            raise self._wrong(name)
        return value

    def _wrong(self, name: str) -> LockError:
        return LockError(
            f"{name} in [tool.envhub] of {self._where} is missing, or nothing that 'envhub lock' "
            "writes"
        )

    def _files(self) -> dict[str, str]:
        files = self._ours.get("files")
        if not isinstance(files, dict) or not 1 <= len(files) <= MAX_FILES:
            raise self._wrong("files")
        return {name: self._text(files, name, _DIGEST) for name in files}

    def _texts(self, name: str) -> tuple[str, ...]:
        rows = self._ours.get(name, [])
        if not isinstance(rows, list) or len(rows) > MAX_TASKS:
            raise self._wrong(name)
        return tuple(self._text({name: row}, name) for row in rows)

    def _requirements(self, name: str) -> tuple[str, ...]:
        try:
            return tuple(
                str(parse_requirement(text, f"{text[:80]!r} in {self._where}"))
                for text in self._texts(name)
            )
        except RequirementError as error:
            raise LockError(str(error)) from error

    def _spaces(self) -> Spaces | None:
        spaces = self._ours.get("spaces")
        if spaces is None:
            return None
        tasks = spaces.get("tasks") if isinstance(spaces, dict) else None
        if not isinstance(tasks, list) or not 1 <= len(tasks) <= MAX_TASKS:
            raise self._wrong("spaces")
        return Spaces(self._text(spaces, "env-kwargs"), tuple(map(self._task, tasks)))

    def _task(self, given: object) -> TaskFingerprint:
        if not isinstance(given, dict) or type(given.get("task")) not in (int, str):
            raise self._wrong("tasks")
        return TaskFingerprint(
            self._text(given, "suite"),
            given["task"],
            self._text(given, "autoreset-mode"),
            self._text(given, "observations"),
            self._text(given, "actions"),
            self._text(given, "spaces", _DIGEST),
        )


def written(lock: LockFile) -> str:
    """The file's text."""
    runner = lock.runner
    head = [
        "# Written by 'envhub lock'; 'envhub lock --upgrade' writes it again.",
        'lock-version = "1.0"',
        'created-by = "envhub-sandbox"',
        f"requires-python = {quoted(f'=={runner.python}.*')}",
    ]
    facts = {
        "repository": lock.repository,
        "commit": lock.commit,
        "entry": lock.entry,
        "implementation": runner.implementation,
        "python": runner.python,
        "machine": runner.machine,
    }
    if lock.exclude_newer is not None:
        facts["exclude-newer"] = lock.exclude_newer
    ours = ["", "[tool.envhub]", f"format = {FORMAT}"]
    ours += [f"{name} = {quoted(value)}" for name, value in facts.items()]
    lists = {name: getattr(lock, name) for name in (*_REQUIREMENTS, "inferred", "assets")}
    ours += [
        f"{name} = [{', '.join(map(quoted, texts))}]"
        for name, texts in lists.items()
        if texts or name == "extra" or (name == "only" and texts is not None)
    ]
    ours += ["", "[tool.envhub.files]"]
    ours += [f"{quoted(name)} = {quoted(digest)}" for name, digest in sorted(lock.files.items())]
    if lock.spaces is not None:
        ours += ["", "[tool.envhub.spaces]", f"env-kwargs = {quoted(lock.spaces.arguments)}"]
        ours += ["tasks = [", *map(_task_line, lock.spaces.tasks), "]"]
    return "\n".join([*head, pylock.written(lock.packages), *ours, ""])


def _task_line(task: TaskFingerprint) -> str:
    name = str(task.task) if isinstance(task.task, int) else quoted(task.task)
    return (
        f"    {{ suite = {quoted(task.suite)}, task = {name}, "
        f"autoreset-mode = {quoted(task.mode)}, "
        f"observations = {quoted(task.observations)}, actions = {quoted(task.actions)}, "
        f"spaces = {quoted(task.spaces)} }},"
    )


def write(lock: LockFile, path: Path) -> None:
    """Write a lock file; meanwhile others read the old one. Raises ``LockError``."""
    try:
        write_whole_file(path, written(lock).encode(), mode=0o666)
    except (OSError, UnicodeEncodeError) as error:
        raise LockError(f"the lock {path} cannot be written: {error}") from error
