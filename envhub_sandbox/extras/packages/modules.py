"""Finds the modules that a repository imports, the package of each, and advice for missing ones.

The repository's pyproject.toml or our table, ``modules.txt``, names the package of a module; never
an index: anybody may publish a package under a module's name.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import sys
import sysconfig
from collections.abc import Collection, Mapping, Sequence
from functools import cache, lru_cache
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TYPE_CHECKING

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.folders import cache_root, keep, recall
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.runtime import mapped_modules
from envhub_worker.protocol.text import first_of, printable

if TYPE_CHECKING:
    from envhub_sandbox.extras.packages.declared import DeclaredPackages, WantedPackage

_FORMAT = 2
_READ: dict[tuple[Path, str], tuple[tuple[str, str, int], ...]] = {}
_MOST = 64
_MOST_NOTED = 4
"""Modules noted for one commit: each costs another installation."""
_SHOWN = 20
_LONGEST = 100
_MISSING = r"No module named '([\w.]+)'"
_REMOVED = {
    **dict.fromkeys(("asynchat", "asyncore", "distutils", "imp", "smtpd"), "3.11"),
    **dict.fromkeys(("cgi", "cgitb", "crypt", "imghdr", "pipes", "sndhdr", "telnetlib"), "3.12"),
}
"""Modules that Python itself had, and the last release that has them."""
_WORKERS = {"cloudpickle", "gymnasium", "msgpack", "numpy", "farama_notifications"}
"""Modules that every jail has."""
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
    (
        r"(CartPole|MountainCar|MountainCarContinuous|Pendulum|Acrobot)-v\d drawn",
        ("pygame", "gymnasium[classic-control]", "pygame pygame-ce"),
    ),
    (
        r"(Blackjack|CliffWalking|CliffWalkingSlippery|FrozenLake|FrozenLake8x8|Taxi)-v\d drawn",
        ("pygame", "gymnasium[toy-text]", "pygame pygame-ce"),
    ),
)
"""Extras of Gymnasium, by patterns of the ids that need them; ``drawn`` follows an id that the
repository makes with a ``render_mode``."""


@dataclass(frozen=True)
class Guess:
    """An imported module, the requirement for it (with the place of the import), and the canonical
    names of the distributions that bring it.
    """

    module: str
    wanted: WantedPackage
    brought_by: tuple[str, ...]

    @property
    def facts(self) -> dict[str, str]:
        """Returns the entry in the provenance."""
        return {
            "module": self.module,
            "requirement": str(self.wanted.requirement),
            "where": self.wanted.where,
        }

    def is_among(self, names: Collection[str]) -> bool:
        """Tells whether one of these distributions, by canonical name, brings the module."""
        return not set(self.brought_by).isdisjoint(names)


def guessed(snapshot: Snapshot) -> tuple[Guess, ...]:
    """Returns guesses for the imported modules whose package is known.

    Includes modules that declared packages bring, since these are known only after resolution.
    """
    return _guessed(snapshot.root, read(snapshot))


@lru_cache(maxsize=64)
def _guessed(root: Path, rows: tuple[tuple[str, str, int], ...]) -> tuple[Guess, ...]:
    extras: dict[str, WantedPackage] = {}
    if rows and (root / "pyproject.toml").is_file():
        from envhub_sandbox.extras.packages.declared import optional

        extras = optional(root)
    guesses: dict[str, Guess] = {}
    for name, file, line in rows:
        guess = _of_id(name) if "-" in name else _of_module(name, extras)
        if guess is not None and len(guesses) < _MOST:
            # late: packaging takes half of the time of a make_env whose manifest is known
            from envhub_sandbox.extras.packages.declared import parse_requirement

            module, requirement, brought_by = guess
            wanted = parse_requirement(
                requirement,
                f"{printable(file, 200)}, line {line}, which needs {module}" if line else file,
            )
            guesses.setdefault(requirement, Guess(module, wanted, tuple(brought_by)))
    return tuple(guesses.values())


def _of_id(text: str) -> tuple[str, str, list[str]] | None:
    for pattern, (module, requirement, names) in _GYMNASIUM:
        if re.fullmatch(pattern, text):
            return module, requirement, names.split()
    return None


def canonical(name: str) -> str:
    """Returns the name by which an index knows a distribution. Without packaging, whose import
    takes half of the time of a make_env whose manifest is known.
    """
    return re.sub(r"[-_.]+", "-", name).lower()


def _of_module(name: str, extras: Mapping[str, WantedPackage]) -> tuple[str, str, list[str]] | None:
    distributions = _distributions(name)
    # of its own name, too: pygame-ce is the usual one for pygame, and who declares pygame has it
    every = [*distributions, name.partition(".")[0]]
    names = list(map(canonical, every))
    own = next(
        (str(extras[distribution].requirement) for distribution in names if distribution in extras),
        None,
    )
    if own is None and not distributions:
        return None
    return name.partition(".")[0], own or distributions[0], names


def _distributions(module: str) -> list[str]:
    """Returns the distributions that bring a module, the usual first; empty if none is known."""
    table = _table()
    while module and module not in table:
        module = module.rpartition(".")[0]
    return table.get(module, [])


@cache
def _table() -> dict[str, list[str]]:
    text = Path(__file__).with_name("modules.txt").read_text("utf-8")
    rows = [line.split() for line in text.splitlines() if not line.startswith("#")]
    own = {module: [module] for sign, *names in rows if sign == "=" for module in names}
    return own | {
        module: [] if names == ["-"] else names for module, *names in rows if module != "="
    }


def is_here(guess: Guess) -> bool:
    """Tells whether a jail in this interpreter can import a guess's module. Imports nothing.

    A jail lacks three sources of this process's modules: the program's folder, the current folder,
    and PYTHONPATH.
    """
    program = getattr(sys.modules.get("__main__"), "__file__", None)
    own = {"", os.getcwd()}
    own.update(map(os.path.abspath, os.environ.get("PYTHONPATH", "").split(os.pathsep)))
    if program and sys.path[0] == os.path.dirname(os.path.abspath(program)):
        own.add(sys.path[0])
    folders = [path for path in sys.path if path not in own]
    return not _built_on_import(guess.module) and bool(_path_here(guess.module, folders))


def _path_here(module: str, folders: Sequence[str]) -> str:
    """Returns the path of a top-level module in this process; empty if there is none. Asks only
    Python's own finder, since other finders may install the modules that they are asked for.
    """
    mapped = mapped_modules(sys.meta_path).get(module)
    spec = None if mapped else PathFinder.find_spec(module, folders)
    if spec is None:
        return mapped[0] if mapped else _built_on_import(module)
    return spec.origin or next(iter(spec.submodule_search_locations or ()), "")


def _built_on_import(module: str) -> str:
    """Returns the folder where Meson's finder builds a module at each import."""
    for finder in sys.meta_path:
        if module in getattr(finder, "_top_level_modules", ()):
            return str(getattr(finder, "_build_path", finder))
    return ""


def read(snapshot: Snapshot) -> tuple[tuple[str, str, int], ...]:
    """Returns imported modules that the repository lacks, and ids of environments; file and line.

    Remembers them by commit, since another process must parse the files. The snapshot is not the
    key: it lists its files, and thousands of files would be hashed and kept in memory.
    """
    place = snapshot.root, snapshot.path  # a root holds only one commit
    if place not in _READ:
        if len(_READ) >= _MOST:
            _READ.clear()
        _READ[place] = _recalled(snapshot)
    return _READ[place]


def note_missing(snapshot: Snapshot, said: str) -> bool:
    """Remember a module that a repository's packages import, by the text of an error; False if it
    was known, or its package is unknown.

    Trust: text from the worker. It selects a module of our table, as an entry file can too.
    """
    module = match[1][:_LONGEST] if (match := re.search(_MISSING, said)) else ""
    imports = read(snapshot)
    names = _WORKERS.union(name.partition(".")[0] for name, _, _ in imports)
    noted = sum(line == 0 for _, _, line in imports)
    if not _distributions(module) or module.partition(".")[0] in names or noted >= _MOST_NOTED:
        return False
    rows = *imports, (module, f"a package of it, which imports {module}", 0)
    _READ[snapshot.root, snapshot.path] = rows
    keep(*_place(snapshot), json.dumps(rows))
    return True


def _place(snapshot: Snapshot) -> tuple[Path, str]:
    """Returns the folder and the file name of a commit's remembered modules."""
    facts = json.dumps([_FORMAT, sys.version_info[:2], snapshot.commit, snapshot.path])
    return cache_root() / "imports", hashlib.sha256(facts.encode()).hexdigest()


def _recalled(snapshot: Snapshot) -> tuple[tuple[str, str, int], ...]:
    place = _place(snapshot)
    with contextlib.suppress(ValueError, TypeError):
        rows = json.loads(recall(*place) or "")
        return tuple((str(name), str(file), int(line)) for name, file, line in rows)
    from envhub_sandbox.extras.sources import parsing

    files = parsing.read(snapshot)
    rows_found = [
        (statement.module, statement.file, statement.line)
        for statement in parsing.imports(snapshot, files)
    ]
    rows_found = [row for row in rows_found if row[0].partition(".")[0] not in _WORKERS]
    rows = [*rows_found, *(row for row in parsing.ids(snapshot, files) if _of_id(row[0]))]
    keep(*place, json.dumps(rows))
    return tuple(rows)


@dataclass(frozen=True)
class MissingModule:
    """Advice for a failed import: the sandbox (``place``), the source of packages (``where``, see
    ``Choice``), the caller's interpreter, and whether the repository ran in an environment of its
    own.
    """

    snapshot: Snapshot
    place: str
    where: str
    python: str | Path | None
    own: bool

    def advice(self, said: str = "") -> str:
        """Returns the declared packages, the place that imports the module in the error ``said``,
        and what to do.
        """
        from envhub_sandbox.extras.packages.declared import declared

        module = match[1] if (match := re.search(_MISSING, said)) else ""
        try:
            says = declared(self.snapshot.root, self.snapshot.path)
        except DependencyError as error:
            return f"What it declares cannot be taken: {error}"
        return f"{_what(says, self.snapshot)}.{self._where(module)} {self._cure(module, says)}"

    def _where(self, module: str) -> str:
        for name, file, line in read(self.snapshot) if module else ():
            if line and name.partition(".")[0] == module.partition(".")[0]:
                return f" {printable(file, 200)}, line {line} imports {name}."
        return ""

    def _cure(self, module: str, says: DeclaredPackages | None) -> str:
        names = _distributions(module)
        top = module.partition(".")[0]
        if python := _REMOVED.get(top):
            older = option_name("dependencies", {"python": python, "fetch_python": True})
            return f"Python {python} is the last that has {module}; {older} takes it"
        if "." in module and module not in _table():
            return f"{top} is there, and has no {module}: only another release of it may have it"
        path = _path_here(top, sys.path) if top else ""
        if path and not names:  # an index may have another package of that name
            return self._local(top, path)
        cure = self._install(next(iter(names), "NAME-OF-THE-PACKAGE"), says)
        if names or not module or self._where(module):
            return cure
        return f"An installed package imports {module}, and none is known that brings it. {cure}"

    def _install(self, name: str, says: DeclaredPackages | None) -> str:
        extra = option_name("dependencies", {"extra": [name]})
        if self.place in ("docker", "remote"):
            return self._elsewhere(extra)
        if self.python is not None:
            return f"It ran in {self.python}: install the package there, or leave out that argument"
        if self.own:
            return f"It ran in an environment of its own; the package joins it with {extra}"
        ran = f"It ran in this interpreter ({sys.executable})"
        if self.where == "host" and says is not None and says.wanted:
            host = option_name("dependencies", "host")
            return f"{ran}, as {host} says; leave that out to give it an environment of its own"
        return f"{ran}; it gets an environment of its own, and the package in it, with {extra}"

    def _local(self, module: str, path: str) -> str:
        """Returns advice for a module that this process can import and the jail cannot."""
        cause = f"{module} is importable here at {path}, which the jail cannot see"
        if self.place == "docker":
            image = option_name("sandbox", "docker:IMAGE")
            return f"{cause}: it ran in a container; name an image that has it, with {image}"
        if self.place == "remote":
            return f"{cause}: it ran on another host, whose operator has to install it"
        if self.own:
            host = option_name("dependencies", "host")
            return f"{cause}: it ran in an environment of its own; {host} runs it in this one"
        python = self.python or sys.executable
        folders = Path(path).absolute().parents
        project = next(
            (parent for parent in folders if (parent / "pyproject.toml").is_file()), None
        )
        project = project or next(
            (parent for parent in folders if (parent / "setup.py").is_file()), None
        )
        editable = "" if _built_on_import(module) else "-e "
        if project is not None:
            words = f"{python} -m pip install {editable}{project}"
            return f"{cause}. If you trust its code, which then runs here, too, install it: {words}"
        folder = folders[Path(path).stem == "__init__"]
        return (
            f"{cause}: it has the packages of {python} alone. Copy the module into the repository, "
            f"or write the line {folder} into a file NAME.pth in {sysconfig.get_path('purelib')}"
        )

    def _elsewhere(self, extra: str) -> str:
        where = "in a container" if self.place == "docker" else "on another host"
        if self.own:
            return f"It ran {where}, with packages of its own; this one joins them with {extra}"
        if self.place == "docker":
            image = option_name("sandbox", "docker:IMAGE")
            return (
                f"It ran {where}, with the image's packages: it gets others with {extra}, or "
                f"with an image that has them (envhub image build REF, then {image})"
            )
        return (
            f"It ran {where}, with the packages of its server: its operator installs the package "
            "into the server's interpreter, or starts the server with --dependencies, and the "
            f"package comes with {extra}"
        )


def _what(found: DeclaredPackages | None, snapshot: Snapshot) -> str:
    if found is not None and found.wanted:
        names = [str(wanted.requirement) for wanted in found.wanted]
        return f"Its {found.source} declares {', '.join(first_of(names, _SHOWN))}"
    from envhub_sandbox.extras.packages.declared import not_read

    seen = not_read(snapshot.root, snapshot.path)
    if seen:
        return (
            f"It has {', '.join(seen)}, which may declare it and is not read: only "
            "requirements.txt, [project] of pyproject.toml and the metadata of a script are"
        )
    return "It declares no packages"
