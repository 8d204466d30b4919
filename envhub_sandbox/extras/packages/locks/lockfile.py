"""Reads and writes lock files: ``pylock.<name>.toml``, with our part under ``[tool.envhub]``.

Trust: the file is the caller's, but may come with a stranger's project. It is read as data within
bounds, and decides only about packages and drift. See ``docs/dependencies.md``.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import DependencyError, LockError
from envhub_sandbox.extras.packages.declared import parse_requirement
from envhub_sandbox.extras.packages.interpreters import Interpreter
from envhub_sandbox.extras.packages.request import DATE
from envhub_sandbox.extras.packages.resolution import pylock
from envhub_sandbox.extras.packages.resolution.pylock import PylockPackage, as_toml, rows
from envhub_sandbox.extras.sources.toml import table
from envhub_sandbox.system.folders import write_whole_file

FORMAT = 1
MAX_FILES = 20_000
MAX_TASKS = 4096
MAX_TEXT = 4096
LOCAL = "local"
"""The name for a folder of this machine, whose path means nothing elsewhere."""
_REQUIREMENTS = ("extra", "only", "override", "without")
_COMMIT = re.compile(r"[0-9a-f]{40}|(local|pypi)-[0-9a-f]+")
_PYTHON = re.compile(r"3\.\d{1,3}")
_WORD = re.compile(r"[a-z0-9_]{1,40}")
_DIGEST = re.compile(r"git-sha1:[0-9a-f]{40}|sha256:[0-9a-f]{64}")
_TEXTS = {"repository": None, "commit": _COMMIT, "entry": None}
_RUNNER = {"implementation": _WORD, "python": _PYTHON, "machine": _WORD}


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
        """Describes an interpreter of this machine."""
        python = ".".join(interpreter.version.split(".")[:2])
        return cls(interpreter.implementation, python, interpreter.machine)


@dataclass(frozen=True)
class TaskFingerprint:
    """One environment, in a form to compare later and elsewhere.

    Attributes:
        suite: Key of the outer mapping.
        task: Key of the inner mapping.
        mode: Its autoreset mode; empty if its metadata names none.
        observations: The observation space of one sub-environment, as text for people.
        spaces: SHA-256 of both spaces, with every bound.
    """

    suite: str
    task: int | str
    mode: str
    observations: str
    actions: str
    spaces: str

    @property
    def name(self) -> str:
        """Returns the name for texts."""
        return f"{self.suite}/{self.task}"


@dataclass(frozen=True)
class Spaces:
    """The environments that ``make_env`` returned for arguments (written by ``arguments_text``)."""

    arguments: str
    tasks: tuple[TaskFingerprint, ...]


@dataclass(frozen=True)
class LockFile:
    """The content of a lock file. Fields that ``Choice`` has too mean the same here.

    Attributes:
        repository: The reference without revision, such as ``"org/repo"``; or ``LOCAL``.
        commit: The full commit; for a folder the hash of its content.
        runner: The interpreter that the packages are for.
        spaces: The environments' spaces; None if the repository was not run.
        inferred: Packages that are imported but not declared, and the place of the import.
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


def reference_of(lock: LockFile) -> str | None:
    """Returns the pinned reference; None for a folder, whose path is unknown."""
    if lock.repository == LOCAL:
        return None
    if lock.commit.startswith("pypi-"):
        return lock.repository
    return f"{lock.repository}@{lock.commit}:{lock.entry}"


def arguments_text(env_kwargs: Mapping[str, Any] | None) -> str | None:
    """Returns arguments in a comparable form; None if JSON cannot express them."""
    try:
        text = json.dumps(dict(env_kwargs or {}), sort_keys=True, allow_nan=False)
    except (TypeError, ValueError):
        return None
    return text if len(text) <= MAX_TEXT else None


def read(path: str | os.PathLike[str]) -> LockFile:
    """Reads a lock file; ``LockError`` if it is unreadable or not one of ours."""
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
    ours = table(document, "tool", "envhub")
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
        text, ours = self._text, self._ours
        texts: dict[str, Any] = {name: text(ours, name, form) for name, form in _TEXTS.items()}
        if "exclude-newer" in ours:
            texts["exclude_newer"] = text(ours, "exclude-newer", re.compile(DATE))
        texts |= {name: self._requirements(name) for name in _REQUIREMENTS if name in ours}
        files = self._ours.get("files")
        if not isinstance(files, dict) or not 1 <= len(files) <= MAX_FILES:
            raise self._wrong("files")
        return LockFile(
            **texts,
            files={name: self._text(files, name, _DIGEST) for name in files},
            runner=Runner(**{name: text(ours, name, form) for name, form in _RUNNER.items()}),
            packages=packages,
            inferred=self._texts("inferred"),
            assets=self._texts("assets"),
            spaces=self._spaces(),
        )

    def _text(
        self, table: Mapping[str, Any], name: str, pattern: re.Pattern[str] | None = None
    ) -> str:
        value = table.get(name)
        if (
            not isinstance(value, str)
            or not value.isprintable()
            or len(value) > MAX_TEXT
            or (pattern is not None and not pattern.fullmatch(value))
        ):
            raise self._wrong(name)
        return value

    def _wrong(self, name: str) -> LockError:
        return LockError(
            f"{name} in [tool.envhub] of {self._where} is missing, or is not as 'envhub lock' "
            "writes it"
        )

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
        except DependencyError as error:
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
    """Returns the text of the file."""
    head = {
        "lock-version": "1.0",
        "created-by": "envhub-sandbox",
        "requires-python": f"=={lock.runner.python}.*",
    }
    ours: dict[str, object] = {"format": FORMAT}
    ours |= {name: getattr(lock, name) for name in _TEXTS} | asdict(lock.runner)
    if lock.exclude_newer is not None:
        ours["exclude-newer"] = lock.exclude_newer
    for name in (*_REQUIREMENTS, "inferred", "assets"):
        texts = getattr(lock, name)
        if texts or name == "extra" or (name == "only" and texts is not None):
            ours[name] = texts
    text = [
        "# Written by 'envhub lock'; 'envhub lock --upgrade' writes it again.",
        *rows(head),
        pylock.written(lock.packages),
        *("", "[tool.envhub]", *rows(ours)),
        *("", "[tool.envhub.files]"),
        *(f"{as_toml(name)} = {as_toml(digest)}" for name, digest in sorted(lock.files.items())),
    ]
    if lock.spaces is not None:
        text += ["", "[tool.envhub.spaces]", *rows({"env-kwargs": lock.spaces.arguments})]
        text += ["tasks = [", *(f"    {as_toml(_task(task))}," for task in lock.spaces.tasks), "]"]
    return "\n".join([*text, ""])


def _task(task: TaskFingerprint) -> dict[str, object]:
    names = {"mode": "autoreset-mode"}
    return {names.get(name, name): value for name, value in asdict(task).items()}


def write(lock: LockFile, path: Path) -> None:
    """Replace a lock file atomically. Raises ``LockError``."""
    try:
        write_whole_file(path, written(lock).encode(), mode=0o666)
    except (OSError, UnicodeEncodeError) as error:
        raise LockError(f"the lock {path} cannot be written: {error}") from error
