"""What a repository imports and may not declare, with the distribution that brings each module.

Which one that is says its own pyproject.toml, or a table of ours, ``modules.txt``; never an index:
anybody may publish a package under a module's name.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TYPE_CHECKING

from envhub_sandbox.dependencies import remembered
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.hub.store import cache_root
from envhub_worker.protocol.text import printable

if TYPE_CHECKING:
    from envhub_sandbox.dependencies.declared import Wanted
    from envhub_sandbox.sources.imports import Import

_FORMAT = 1
_READ: dict[tuple[Path, str], tuple[tuple[str, str, int], ...]] = {}
_MOST = 64
_WORKERS = {"cloudpickle", "gymnasium", "msgpack", "numpy", "farama_notifications"}
"""Modules that are in every jail."""
_GYMNASIUM = (
    (
        r"(Ant|HalfCheetah|Hopper|Humanoid|HumanoidStandup|InvertedDoublePendulum"
        r"|InvertedPendulum|Pusher|Reacher|Swimmer|Walker2d)-v[45]",
        ("mujoco", "gymnasium[mujoco]", "mujoco"),
    ),
    (
        r"(LunarLander|LunarLanderContinuous|BipedalWalker|BipedalWalkerHardcore|CarRacing)-v\d",
        ("Box2D", "gymnasium[box2d]", "box2d box2d-py"),
    ),
    (r"ALE/.*", ("ale_py", "gymnasium[atari]", "ale-py")),
)
"""Environments of Gymnasium's that need an extra of it: by the texts of their ids."""


@dataclass(frozen=True)
class Guess:
    """A module that is imported, and what brings it.

    Attributes:
        module: Its name.
        wanted: The requirement, with the place of the import.
        brought_by: Canonical names of distributions, any of which brings it.
    """

    module: str
    wanted: Wanted
    brought_by: tuple[str, ...]

    @property
    def facts(self) -> dict[str, str]:
        """For the provenance."""
        return {
            "module": self.module,
            "requirement": str(self.wanted.requirement),
            "where": self.wanted.where,
        }

    def is_among(self, names: Collection[str]) -> bool:
        """Whether one of these distributions, by canonical name, brings it."""
        return not set(self.brought_by).isdisjoint(names)


def guessed(snapshot: Snapshot) -> tuple[Guess, ...]:
    """What a repository imports, as far as it is known what brings it.

    What its declared packages bring is among it: that is known once versions are chosen.
    """
    return _guessed(snapshot.root, snapshot.path, read(snapshot))


@lru_cache(maxsize=64)
def _guessed(root: Path, entry: str, rows: tuple[tuple[str, str, int], ...]) -> tuple[Guess, ...]:
    if not rows:
        return ()
    from envhub_sandbox.dependencies.declared import optional, parse_requirement

    extras = optional(root, entry)
    found: dict[str, Guess] = {}
    for name, file, line in rows:
        known = _of_id(name) if "-" in name else _of_module(name, extras)
        if known is not None and len(found) < _MOST:
            module, requirement, brought_by = known
            wanted = parse_requirement(
                requirement, f"{printable(file, 200)}, line {line}, which needs {module}"
            )
            found.setdefault(requirement, Guess(module, wanted, tuple(brought_by)))
    return tuple(found.values())


def _of_id(text: str) -> tuple[str, str, list[str]] | None:
    for pattern, (module, requirement, names) in _GYMNASIUM:
        if re.fullmatch(pattern, text):
            return module, requirement, names.split()
    return None


def _of_module(name: str, extras: Mapping[str, Wanted]) -> tuple[str, str, list[str]] | None:
    distributions = of_module(name)
    names = list(map(_canonical, distributions or [name.partition(".")[0]]))
    own = next((str(extras[one].requirement) for one in names if one in extras), None)
    if own is None and not distributions:
        return None
    return name.partition(".")[0], own or distributions[0], names


def of_module(name: str) -> list[str]:
    """The distributions that bring a module, the usual one first; empty where none is known."""
    table = _table()
    while name:
        if name in table:
            return table[name]
        name = name.rpartition(".")[0]
    return []


@cache
def _table() -> dict[str, list[str]]:
    text = Path(__file__).with_name("modules.txt").read_text("utf-8")
    rows = [line.split() for line in text.splitlines() if not line.startswith("#")]
    return {module: names or [module] for module, *names in rows}


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def is_here(guess: Guess) -> bool:
    """Whether this interpreter can import its module. Nothing is imported."""
    here = [path for path in sys.path if path not in ("", os.getcwd())]
    return PathFinder.find_spec(guess.module, here) is not None


def read(snapshot: Snapshot) -> tuple[tuple[str, str, int], ...]:
    """Modules that a repository imports and does not have, and ids of environments; file and line.

    A commit's are remembered: they are read in a process of their own.
    """
    place = snapshot.root, snapshot.path  # a root holds one commit
    if place not in _READ:
        if len(_READ) >= _MOST:
            _READ.clear()
        _READ[place] = _recalled(snapshot)
    return _READ[place]


def _recalled(snapshot: Snapshot) -> tuple[tuple[str, str, int], ...]:
    folder = cache_root() / "imports"
    facts = json.dumps([_FORMAT, sys.version_info[:2], snapshot.commit, snapshot.path])
    key = hashlib.sha256(facts.encode()).hexdigest()
    text = remembered.recall(folder, key)
    try:
        rows = json.loads(text or "")
        return tuple((str(name), str(file), int(line)) for name, file, line in rows)
    except (ValueError, TypeError):
        rows = _parsed(snapshot)
        remembered.keep(folder, key, json.dumps(rows))
        return tuple(rows)


def _parsed(snapshot: Snapshot) -> list[tuple[str, str, int]]:
    from envhub_sandbox.sources import imports, parsing

    files = parsing.read(snapshot)
    found = [row for row in map(_row, imports.imports(snapshot, files)) if row[0] not in _WORKERS]
    return [*found, *(row for row in imports.ids(snapshot, files) if _of_id(row[0]))]


def _row(one: Import) -> tuple[str, str, int]:
    return one.module, one.file, one.line
