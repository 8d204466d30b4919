"""Reads a repository's declared packages as data from its verified files.

The files are a stranger's. pip and uv obey options, URLs and paths in them, some of which build and
run code at once. So this module accepts only plain requirements, parses each and prints it anew.
The first existing source counts, the most specific first: the metadata of a script (PEP 723) in the
entry file, ``requirements.txt`` beside it or else at the root, and ``[project]`` of
``pyproject.toml``. A requirement may name a git repository, which becomes a ``Source``.
"""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from packaging.requirements import InvalidRequirement, Requirement
from packaging.specifiers import InvalidSpecifier, SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.sources import toml
from envhub_sandbox.extras.sources.toml import table
from envhub_sandbox.settings.options import option_name

_GIT = re.compile(
    r"git\+(?P<url>https://[A-Za-z0-9.-]+(:\d{1,5})?/[A-Za-z0-9._~/-]+?)"
    r"(?:@(?P<revision>[A-Za-z0-9._/-]{1,200}))?(#subdirectory=(?P<folder>[A-Za-z0-9._/-]{1,200}))?"
)


@dataclass(frozen=True)
class Source:
    """A chosen package that has no wheel.

    Attributes:
        name: Its canonical name.
        version: Empty for a git repository.
        url: The URL of the source distribution or the repository.
        sha256: The hash of the source distribution; empty for git.
        commit: The revision in the requirement: a commit, a tag or a branch; or ``HEAD``.
        subdirectory: The project's folder in the repository.
        where: The line that requires the package, for errors.
    """

    name: str
    version: str = ""
    url: str = ""
    sha256: str = ""
    commit: str = ""
    subdirectory: str = ""
    where: str = ""

    @property
    def identity(self) -> str:
        """Identifies the content: the hash of a file, or a full commit."""
        if not self.commit:
            return f"sha256:{self.sha256}"
        below = f"#subdirectory={self.subdirectory}" if self.subdirectory else ""
        return f"git+{self.url}@{self.commit}{below}"


@dataclass(frozen=True)
class WheelOrigin:
    """The origin of a built wheel: its source, the digest of the lock of its build requirements,
    and its own SHA-256.
    """

    source: Source
    environment: str
    wheel: str


def of_git(requirement: Requirement, where: str) -> Source | None:
    """Returns the repository of a requirement; None unless it is ``git+https`` with a revision."""
    match = _GIT.fullmatch(requirement.url or "")
    if match is None or ".." in match[0]:
        return None
    return Source(
        canonicalize_name(requirement.name),
        url=match["url"],
        commit=match["revision"] or "HEAD",
        subdirectory=match["folder"] or "",
        where=where,
    )


PROJECT = "pyproject.toml"
MAX_BYTES = 256 * 1024
MAX_REQUIREMENTS = 1000
MAX_FILES = 16
"""Files that one ``requirements.txt`` may include."""
MAX_LINE = 2000

_HASH = re.compile(r"--hash[= ](sha256:[0-9a-f]{64}|sha384:[0-9a-f]{96}|sha512:[0-9a-f]{128})")
_QUOTED = re.compile(r"'[^']*'|\"[^\"]*\"")
_SCRIPT, _CLOSES = "# /// script", "# ///"
_LOOKED_AT = 1024 * 1024
"""Bytes at the beginning of an entry file that may hold metadata."""
_INCLUDES = re.compile(r"(-r|--requirement|-c|--constraint)[ =]\s*(\S+)")
_ITSELF = re.compile(r"(?:(?:-e|--editable)[ =]\s*)?\./?(?:\[([\w.,\s-]{0,200})\])?")
_BYTE_ORDER_MARKS = {codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
_NOT_READ = ("environment.yml", "environment.yaml", "setup.py", "setup.cfg", "Pipfile", "uv.lock")


@dataclass(frozen=True)
class WantedPackage:
    """One plain requirement.

    Attributes:
        requirement: Name, extras, versions and marker; never a URL.
        where: Its position, such as ``"line 2 of requirements.txt"``.
        hashes: Hashes of its files, such as ``"sha256:..."``; empty if the line has none.
    """

    requirement: Requirement
    where: str
    hashes: tuple[str, ...] = ()

    @property
    def is_open(self) -> bool:
        """Tells whether more than one release may satisfy it."""
        pins = (clause for clause in self.requirement.specifier if clause.operator in ("==", "==="))
        exact = any(not clause.version.endswith(".*") for clause in pins)
        return not (exact or self.hashes or self.requirement.url)

    def __str__(self) -> str:
        return " ".join([str(self.requirement), *(f"--hash={digest}" for digest in self.hashes)])


@dataclass(frozen=True)
class DeclaredPackages:
    """The packages that a repository declares.

    Attributes:
        wanted: Its requirements; may be empty.
        python: The supported versions of Python, such as ``">=3.11"``; empty for any.
        constraints: Limits for packages, if something requires these.
    """

    source: str
    wanted: tuple[WantedPackage, ...]
    python: str = ""
    constraints: tuple[WantedPackage, ...] = ()


def declared(root: Path, entry: str) -> DeclaredPackages | None:
    """Reads the declared packages; None if no file declares any. Raises ``DependencyError``."""
    script = _script(root / entry, entry)
    if script is not None:
        return script
    stated, origin = table(pyproject(root), "project"), f"[project] of {PROJECT}"
    python = _specifier(stated.get("requires-python", ""), origin)
    project = DeclaredPackages(PROJECT, _list(stated.get("dependencies", []), origin), python)
    beside = os.path.join(os.path.dirname(entry), "requirements.txt")
    names = (beside, "requirements.txt")
    listed = next((name for name in names if (root / name).is_file()), None)
    if listed is not None:
        wanted, constraints = read(root, listed)
        return DeclaredPackages(listed, tuple(wanted), project.python, tuple(constraints))
    return project if project.wanted or project.python else None


def optional(root: Path) -> dict[str, WantedPackage]:
    """Returns the packages of a project's extras, by canonical name; empty if unreadable."""
    try:
        extras = table(pyproject(root), "project", "optional-dependencies")
        where = f"[project.optional-dependencies] of {PROJECT}"
        packages = [wanted for row in extras.values() for wanted in _list(row, where)]
    except DependencyError:
        return {}
    return {canonicalize_name(package.requirement.name): package for package in packages}


def not_read(root: Path, entry: str) -> list[str]:
    """Lists the files that declare packages in a form that this module does not read."""
    beside = (root / entry).parent
    names = [name for name in _NOT_READ if (beside / name).is_file() or (root / name).is_file()]
    try:
        data = pyproject(root)
    except DependencyError:
        return names
    if "poetry" in table(data, "tool"):
        names.append(f"[tool.poetry] of {PROJECT}")
    dynamic = table(data, "project").get("dynamic")
    if isinstance(dynamic, list) and "dependencies" in dynamic:
        names.append(f"dynamic dependencies of {PROJECT}")
    return names


def _unsupported(text: str) -> DependencyError:
    return DependencyError(text, reason="requirement")


def parse_requirement(text: str, where: str) -> WantedPackage:
    """Parses a stranger's requirement and the hashes behind it. Raises ``DependencyError``."""
    plain, *hashes = map(str.strip, re.split(r"(?<=\s)(?=--hash[= ])", text))
    if len(plain) > MAX_LINE:
        raise _unsupported(f"{where} has {len(plain)} characters; at most {MAX_LINE} are read")
    matches = [_HASH.fullmatch(digest.strip()) for digest in hashes]
    try:
        requirement = Requirement(plain)
        if not all(matches):
            raise InvalidRequirement("a malformed hash")
        if not _is_literal(plain):
            raise InvalidRequirement("a character that is not printed as itself")
    except (InvalidRequirement, RecursionError) as error:
        raise _unsupported(
            f"{where} is {text[:200]!r}. Only plain requirements such as 'numpy>=2' are supported, "
            "with or without hashes, and 'NAME @ git+https://HOST/PATH@REVISION': other options, "
            f"links, paths and files can run code during the installation. {_advice()}"
        ) from error
    if requirement.url is not None and of_git(requirement, where) is None:
        raise _unsupported(
            f"{where} takes {requirement.name} from {requirement.url[:200]!r}; only packages of "
            f"the index are installed. {_advice()}"
        )
    return WantedPackage(requirement, where, tuple(match[1] for match in matches if match))


def _is_literal(text: str) -> bool:
    """Tells whether a requirement keeps its meaning when it is parsed and printed for uv.

    packaging reads texts in markers with Python's escapes: an escape could end its line or its
    quotes, and the rest would become another line, which uv obeys.
    """
    texts = [quoted[1:-1] for quoted in _QUOTED.findall(text.partition(";")[2])]
    return (
        "\\" not in text
        and text.replace("\t", " ").isprintable()
        and not any("'" in text or '"' in text for text in texts)
    )


def read(root: Path, name: str) -> tuple[list[WantedPackage], list[WantedPackage]]:
    """Returns the plain requirements in a ``requirements.txt``, and the constraints.

    Also reads the repository's files that it includes (``-r``, ``-c``).
    """
    wanted: list[WantedPackage] = []
    constraints: list[WantedPackage] = []
    waiting, seen = [(name, False)], {(name, False)}
    while waiting:
        file, constrains = waiting.pop(0)
        for number, line in _joined(_text(root / file, file).splitlines()):
            where = f"line {number} of {file}"
            if included := _INCLUDES.fullmatch(line):
                further = _beside(root, file, included[2], where)
                row = (further, constrains or included[1] in ("-c", "--constraint"))
                if row not in seen:
                    seen.add(row)
                    waiting.append(row)
            elif not constrains and (itself := _ITSELF.fullmatch(line)):
                wanted += _of_itself(root, itself[1] or "", where)
            else:
                (constraints if constrains else wanted).append(parse_requirement(line, where))
        _bounded(len(wanted) + len(constraints), name)
        if len(seen) > MAX_FILES:
            raise _unsupported(f"{name} includes more than {MAX_FILES} files. {_advice()}")
    return wanted, constraints


def _of_itself(root: Path, extras: str, where: str) -> Iterator[WantedPackage]:
    """Yields the requirements of ``-e .``; the repository's own modules are there already."""
    project = pyproject(root).get("project")
    if not isinstance(project, dict):
        raise _unsupported(
            f"{where} installs the repository itself, but its requirements are read only from "
            f"[project] of {PROJECT}, which does not exist. {_advice()}"
        )
    yield from _list(project.get("dependencies", []), f"[project] of {PROJECT}")
    for name in filter(None, map(str.strip, extras.split(","))):
        rows = table(project, "optional-dependencies").get(name, [])
        yield from _list(rows, f"[project.optional-dependencies] of {PROJECT}")


def _beside(root: Path, file: str, named: str, where: str) -> str:
    """Returns the path, relative to the root, of a repository's file that another file names."""
    path = os.path.normpath(os.path.join(os.path.dirname(file), named))
    inside = not os.path.isabs(path) and path.split(os.sep)[0] != ".." and "://" not in named
    if not inside or not _is_file(root / path):
        raise _unsupported(
            f"{where} names {named[:200]!r}, which is not a file of the repository. {_advice()}"
        )
    return path


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that no file can have
        return False


def _joined(lines: Sequence[str]) -> Iterator[tuple[int, str]]:
    """Yields lines without comments and their numbers; a backslash joins a line with the next."""
    parts: list[str] = []
    first = 0
    for number, raw in enumerate(lines, start=1):
        line = "" if raw.lstrip().startswith("#") else raw.split(" #", 1)[0].strip()
        first = first if parts else number
        goes_on = line.endswith("\\") and number < len(lines)
        parts.append(line[:-1].strip() if goes_on else line)
        if goes_on:
            continue
        whole = " ".join(part for part in parts if part)
        parts = []
        if whole:
            yield first, whole


def _script(path: Path, name: str) -> DeclaredPackages | None:
    """Reads the metadata in an entry file, after https://peps.python.org/pep-0723/."""
    try:
        with path.open("rb") as file:
            lines = file.read(_LOOKED_AT).decode("utf-8", "replace").splitlines()
    except OSError as error:
        raise _unsupported(f"{name} cannot be read: {error}") from error
    starts = [number for number, line in enumerate(lines) if line.rstrip() == _SCRIPT]
    blocks = [block for block in (_block(lines, start) for start in starts) if block is not None]
    if not blocks:
        return None
    if len(blocks) > 1:
        raise _unsupported(f"{name} has {len(blocks)} blocks {_SCRIPT!r}; one is permitted")
    origin = f"the script metadata of {name}"
    data = _toml(blocks[0], origin)
    python = _specifier(data.get("requires-python", ""), origin)
    return DeclaredPackages(name, _list(data.get("dependencies", []), origin), python)


def _block(lines: Sequence[str], start: int) -> str | None:
    """Returns the text between the opening line and the last closing line of the same comment."""
    inside: list[str] = []
    closed = None
    for line in lines[start + 1 :]:
        if line.rstrip() == _SCRIPT or not (line == "#" or line.startswith("# ")):
            break
        if line.rstrip() == _CLOSES:
            closed = len(inside)
        inside.append(line[2:])
    return None if closed is None else "\n".join(inside[:closed])


def pyproject(root: Path, where: str = PROJECT) -> dict[str, Any]:
    """Returns the content of ``pyproject.toml``; empty if there is no file."""
    path = root / PROJECT
    return _toml(_text(path, where), where) if path.is_file() else {}


def _toml(text: str, where: str) -> dict[str, Any]:
    try:
        return toml.loads(text, MAX_BYTES)
    except ValueError as error:
        raise _unsupported(f"{where} is not valid TOML: {error}. {_advice()}") from error


def _list(found: object, where: str) -> tuple[WantedPackage, ...]:
    if not isinstance(found, list) or not all(isinstance(item, str) for item in found):
        raise _unsupported(f"dependencies in {where} is not a list of strings. {_advice()}")
    _bounded(len(found), where)
    return tuple(parse_requirement(item, f"{item[:80]!r} in {where}") for item in found)


def _specifier(found: object, where: str) -> str:
    try:
        if not isinstance(found, str) or len(found) > MAX_LINE:
            raise InvalidSpecifier("no text")
        return str(SpecifierSet(found))
    except InvalidSpecifier as error:
        raise _unsupported(
            f"requires-python in {where} is {str(found)[:80]!r}, which is not a range of versions "
            f"such as '>=3.11'. {_advice()}"
        ) from error


def check_versions(asked: str) -> None:
    """Raise ``ValueError`` unless a text is a version, a set of versions or a path."""
    if os.sep not in asked:
        versions(asked)


def versions(asked: str) -> SpecifierSet:
    """Parses a caller's version or set of versions; otherwise raises ``ValueError``."""
    try:
        return SpecifierSet(f"=={Version(asked)}.*" if asked.count(".") < 2 else f"=={asked}")
    except (InvalidVersion, InvalidSpecifier):
        return SpecifierSet(asked)


def _bounded(count: int, where: str) -> None:
    if count > MAX_REQUIREMENTS:
        raise _unsupported(
            f"{where} has {count} requirements; at most {MAX_REQUIREMENTS} are read. {_advice()}"
        )


def _text(path: Path, name: str) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        # PowerShell writes UTF-16
        text = data.decode(_BYTE_ORDER_MARKS.get(data[:2], "utf-8-sig"))
    except (OSError, UnicodeDecodeError) as error:
        raise _unsupported(f"{name} cannot be read: {error}") from error
    if len(data) > MAX_BYTES:
        raise _unsupported(f"{name} is too long; at most {MAX_BYTES} bytes are read. {_advice()}")
    return text


def _advice() -> str:
    return (
        f"If you trust it, use another interpreter with {option_name('python', 'PATH')}, this one "
        f"with {option_name('dependencies', 'host')}, or your own list with "
        f"{option_name('dependencies', {'only': ['NAME']})}"
    )
