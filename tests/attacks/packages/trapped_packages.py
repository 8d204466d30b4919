"""Folders of packages with traps: code that would run before anybody asked for it, or for another.
Each trap leaves a file in a folder that every user may write to, and so says where it ran: a jail
cannot reach that folder, and whatever else runs it can."""

import contextlib
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.support.packages.environments import base_interpreter

REAL = ("cloudpickle", "farama_notifications", "gymnasium", "msgpack", "numpy", "typing_extensions")
STANDARD = ("ctypes", "encodings", "json")
"""Of the standard library: a package of the same name must never take its place."""
REPLACED = (*STANDARD, "msgpack", "numpy", "envhub_worker")
AT_START = ("a .pth file", "sitecustomize", "usercustomize")
TRAPS = (*AT_START, *(f"its own {name}" for name in REPLACED))

# With the interpreter's built-in modules alone: at this point there may be no other.
_TRAP = """
import posix, sys
sys.__dict__.setdefault("trapped", []).append(({name!r}, posix.getpid()))
try:
    posix.close(posix.open({canary!r}, posix.O_WRONLY | posix.O_CREAT, 0o666))
except OSError:
    pass
"""
_USE = "import ctypes, encodings, json, envhub_worker, msgpack, numpy, gymnasium"


def canary(home: Path, name: str) -> Path:
    """What a trap leaves where it can."""
    return home / f"{name.replace(' ', '-')} was here"


def trap(home: Path, name: str) -> str:
    return _TRAP.format(name=name, canary=os.fsencode(canary(home, name)))


def copy_of(source: Path, target: Path) -> None:
    """A file or a folder, by links where that is possible; the copy of a tree may be added to."""
    if source.is_dir():
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(source, target, copy_function=_link, ignore=ignore)
    else:
        _link(str(source), str(target))


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def real_packages(folder: Path) -> None:
    """What the worker needs, as it is installed for the tests themselves."""
    folder.mkdir()
    for name in REAL:
        spec = importlib.util.find_spec(name)
        origin = Path(spec.origin)
        place = origin.parent if origin.name == "__init__.py" else origin
        copy_of(place, folder / place.name)
        libraries = place.with_name(f"{name}.libs")
        if libraries.is_dir():
            copy_of(libraries, folder / libraries.name)


def set_traps(folder: Path, home: Path) -> None:
    """All traps of ``TRAPS`` in a folder of packages; what is replaced goes on as it should."""
    (folder / "start.py").write_text(trap(home, "a .pth file"))
    (folder / "start.pth").write_text("import start\n")
    for name in AT_START[1:]:
        (folder / f"{name}.py").write_text(trap(home, name))
    for name in STANDARD:
        module = sys.modules.get(name) or importlib.import_module(name)
        copy_of(Path(module.__file__).parent, folder / name)
    (folder / "envhub_worker").mkdir()
    (folder / "envhub_worker" / "__init__.py").touch()
    for name in REPLACED:
        first = folder / name / "__init__.py"
        text = first.read_text()
        first.unlink()  # a link to somebody else's file
        first.write_text(_with_trap(text, trap(home, f"its own {name}")))


def _with_trap(text: str, source: str) -> str:
    """Behind the ``from __future__`` lines, which have to be the first."""
    future = [line for line in text.splitlines() if line.startswith("from __future__")]
    rest = "\n".join(line for line in text.splitlines() if line not in future)
    return "\n".join([*future, source, rest])


def use_unprotected(folder: Path, place: Path) -> None:
    major, minor = sys.version_info[:2]
    library = place / f"lib/python{major}.{minor}"
    library.mkdir(parents=True)
    (library / "site-packages").symlink_to(folder)
    (place / "bin").mkdir()
    (place / "bin/python").symlink_to(base_interpreter())
    home = Path(base_interpreter()).parent
    text = f"home = {home}\ninclude-system-site-packages = true\n"
    (place / "pyvenv.cfg").write_text(text)
    # once as whoever starts it finds it, once for who has it on the path
    for variables in ({}, {"PYTHONPATH": str(folder)}):
        command = [str(place / "bin/python"), "-c", _USE if variables else "import gymnasium"]
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run(command, env={**os.environ, **variables}, timeout=120, check=False)
