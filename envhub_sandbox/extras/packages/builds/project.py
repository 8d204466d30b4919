"""Reads a project's build settings (PEP 517, 518) as data, and tells what a failed build lacked."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages.declared import WantedPackage, parse_requirement, pyproject

_LEGACY = ("setuptools", "wheel")
_LEGACY_BACKEND = "setuptools.build_meta:__legacy__"
_MOST = 200


@dataclass(frozen=True)
class Project:
    """The build settings: packages, the backend (``module:object``), and the folders of the sources
    that Python searches first for the backend.
    """

    requires: tuple[WantedPackage, ...]
    backend: str
    backend_path: tuple[str, ...] = ()


def read(tree: Path, title: str) -> Project:
    """Reads the build settings; without settings, setuptools builds the sources."""
    table = f"[build-system] of {title}"
    build_system = pyproject(tree, table).get("build-system", {})
    if not isinstance(build_system, dict):
        raise DependencyError(f"{table} is not a table", reason="requirement")
    requires = _texts(build_system.get("requires", list(_LEGACY)), table)
    backend = build_system.get("build-backend", _LEGACY_BACKEND)
    paths = _texts(build_system.get("backend-path", []), table)
    if not isinstance(backend, str) or not all(
        map(str.isidentifier, backend.replace(":", ".", 1).split("."))
    ):
        raise DependencyError(
            f"{table}: {str(backend)[:200]!r} is not a build backend", reason="requirement"
        )
    return Project(tuple(parse_requirement(text, table) for text in requires), backend, paths)


def _texts(found: object, where: str) -> tuple[str, ...]:
    if not isinstance(found, list) or len(found) > _MOST:
        raise DependencyError(f"{where} must list at most {_MOST} strings", reason="requirement")
    if not all(isinstance(item, str) and item.isprintable() for item in found):
        raise DependencyError(f"{where} has an entry that is not a string", reason="requirement")
    return tuple(found)


_PROGRAMS = {
    "gcc": "gcc",
    "cc": "gcc",
    "g++": "g++",
    "c++": "g++",
    "clang": "clang",
    "gfortran": "gfortran",
    "cmake": "cmake",
    "make": "make",
    "ninja": "ninja-build",
    "swig": "swig",
    "cargo": "cargo",
    "rustc": "rustc",
    "go": "golang",
    "pkg-config": "pkg-config",
    "sdl2-config": "libsdl2-dev",
    "git": "git",
}
_WHEELS = {"cmake": "cmake<4", "ninja": "ninja", "swig": "swig<5"}
"""Build programs that PyPI has as wheels; CMake in a version that reads old projects."""
_HEADERS = {
    "Python.h": "python3-dev",
    "linux/input.h": "linux-libc-dev",
    "SDL.h": "libsdl2-dev",
    "GL/gl.h": "libgl1-mesa-dev",
    "GL/osmesa.h": "libosmesa6-dev",
    "ffi.h": "libffi-dev",
    "zlib.h": "zlib1g-dev",
    "stdio.h": "libc6-dev",
}
_PROGRAM_PATTERNS = (
    r"command '([^'\s]+)' failed: No such file or directory",
    r"unable to execute '([^'\s]+)': No such file",
    r"No such file or directory: '([^'\s]+)'",
    r"(?:^|\n)(?:/bin/)?sh: (?:\d+: |line \d+: )?([\w.+-]+): (?:command )?not found",
    r"(?<![\w+.-])([\w+.-]+): command not found",
    r"(?i)\b(cmake|swig|cargo|rustc|pkg-config|ninja)\b[^\n]{0,40}"
    r"(?:must be installed|is required|not found|could not be found)",
)
_COMPILERS = re.compile(
    r"No CMAKE_(C|CXX)_COMPILER could be found|Unknown compiler\(s\)|no acceptable C compiler"
)
_HEADER = re.compile(r"fatal error: ([\w./+-]{1,100}): No such file or directory")
_LIBRARY = re.compile(r"cannot find -l([\w.+-]{1,60})")
_NETWORK = re.compile(
    r"Temporary failure in name resolution|Name or service not known|Network is unreachable"
    r"|Could not resolve host|URLError|ConnectionError|Failed to establish a new connection"
)


def wheel_for(log: str) -> str:
    """Returns the package whose wheel brings the missing program; empty if there is no wheel."""
    return _WHEELS.get(_program(log), "")


def advice(log: str) -> str:
    """Returns one sentence: what to install or to do; empty for an unknown failure."""
    if program := _program(log):
        return f"It needs {program}, which is not found here. {_install(_PROGRAMS[program])}"
    if _COMPILERS.search(log):
        return f"It needs a C or C++ compiler, and none is found here. {_install('gcc g++')}"
    if match := _HEADER.search(log):
        package = _HEADERS.get(match[1], "")
        how = _install(package) if package else "Install the development package that has it"
        return f"It needs the header {match[1]}, which is not found here. {how}"
    if library := _LIBRARY.search(log):
        needs = f"It needs the library {library[1]}, which is not found here"
        return f"{needs}. Install the development package that has it"
    if _NETWORK.search(log):
        return "It wants the network while it is built, and gets none"
    return ""


def _program(log: str) -> str:
    for pattern in _PROGRAM_PATTERNS:
        for match in re.finditer(pattern, log):
            name = match[1].rpartition("/")[2].lower()
            short = re.sub(r"^[a-z0-9_]+-linux-gnu-", "", name)
            if short in _PROGRAMS:
                return short
    return ""


def _install(package: str) -> str:
    return f"On Debian and Ubuntu: apt-get install {package}"
