"""Programs that are started under another umask, or without standard streams, have environments as
any other; what is private stays so."""

import json
import os
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import envhub_sandbox
import envhub_worker
from envhub_sandbox import make_env
from tests.remote.listening import WORKER, counting, listening
from tests.support.processes import eventually
from tests.support.samples import sample

UMASKS = ["000", "077"]
_RUN = """
import sys
from envhub_sandbox import make_env
with make_env(sys.argv[1]) as suites:
    envs = next(iter(next(iter(suites.values())).values()))
    envs.reset(seed=1)
    print("stepped", envs.step(envs.action_space.sample())[0].shape)
"""


def under(umask: str, *command: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", "-c", f'umask {umask} && exec "$@"', "sh", *map(str, command)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, **environment},
    )


def open_to_others(folder: Path) -> list[tuple[str, str]]:
    """What others can write, or read of what is private, with its mode."""
    found = []
    for path in folder.rglob("*"):
        mode = stat.S_IMODE(path.lstat().st_mode)
        private = "snapshots" not in path.parts and path.parent != folder
        if mode & (0o077 if private else 0o022):
            found.append((str(path), f"{mode:04o}"))
    return found


@pytest.mark.parametrize("umask", UMASKS)
def test_an_environment_runs(tmp_path: Path, umask: str) -> None:
    """From the first folder of an empty cache on; none of them is open to others."""
    cache = tmp_path / "cache"
    done = under(umask, sys.executable, "-c", _RUN, sample("cartpole"), ENVHUB_CACHE=str(cache))
    assert "stepped (1, 4)" in done.stdout, done.stderr
    assert (cache / "manifests").is_dir()
    assert open_to_others(cache) == []


def test_from_an_archive_it_says_what_to_do(tmp_path: Path) -> None:
    """Without the archive the same program runs: the tests above."""
    archive = tmp_path / "program.pyz"
    with zipfile.ZipFile(archive, "w") as file:
        for module in (envhub_sandbox, envhub_worker):
            package = Path(*module.__path__)
            for path in package.rglob("*.py"):
                file.write(path, path.relative_to(package.parent))
    words = sys.executable, "-c", _RUN, sample("cartpole")
    done = under("022", *words, PYTHONPATH=str(archive))
    assert f"SandboxUnavailableError: {archive}/envhub_worker is no folder" in done.stderr
    assert "leave it out of the archive" in done.stderr


@pytest.mark.parametrize("umask", UMASKS)
def test_a_bundle_is_its_owners(tmp_path: Path, umask: str) -> None:
    (tmp_path / "env.py").write_text("import os\nos._exit(3)\n")
    cache = tmp_path / "cache"
    done = under(umask, sys.executable, "-c", _RUN, tmp_path, ENVHUB_CACHE=str(cache))
    assert "WorkerDiedError" in done.stderr
    bundle = next((cache / "crashes").iterdir())
    assert {path.name for path in bundle.iterdir()} >= {"bundle.json", "README.txt"}
    assert (stat.S_IMODE(bundle.stat().st_mode), open_to_others(cache)) == (0o700, [])


@pytest.mark.parametrize("umask", UMASKS)
def test_a_listening_server_serves(tmp_path: Path, umask: str) -> None:
    """Its jails get through to the snapshots that clients brought; other users see none."""
    prefix = ("sh", "-c", f'umask {umask} && exec "$@"', "sh")
    with listening(tmp_path / "server", prefix=prefix) as server:
        with make_env(counting(tmp_path / "repository"), sandbox=server.sandbox()) as suites:
            suites.env.reset(seed=1)
        store = server.state / "store"
        folders = [server.state, store, *store.glob("*"), *store.glob("*/*")]
        assert {folder.name for folder in folders} >= {"blobs", "trees"}
        assert all(folder.stat().st_mode & 0o066 == 0 for folder in folders)


def test_a_state_folder_that_others_can_write_is_refused(tmp_path: Path) -> None:
    mode = 0o770
    (tmp_path / "state").mkdir()
    (tmp_path / "state").chmod(mode)
    command = [*WORKER, "listen", "--bind", "tcp://127.0.0.1:*", "--state-dir", tmp_path / "state"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert f"{mode:04o}" in done.stderr
    assert list((tmp_path / "state").iterdir()) == []


_PROGRAM = """
import json, os, sys, traceback
told = {"missing": [name for name in ("stdin", "stdout", "stderr") if getattr(sys, name) is None]}
try:
    from envhub_sandbox import make_env
    with make_env(sys.argv[1], n_envs=2) as suites:
        suites.env.reset(seed=1)
        for _ in range(3):
            os.write(1, b"what C code prints") and os.write(2, b"and warns of")
            observation = suites.env.step(suites.env.action_space.sample())[0]
    told["shape"] = observation.shape
except BaseException:
    told["error"] = traceback.format_exc()
with open(sys.argv[2], "w") as file:
    json.dump(told, file)
"""
CLOSED = {"<&- >&- 2>&-": ["stdin", "stdout", "stderr"]}


def without(streams: str, *command: object) -> int:
    """The exit code of a command that a shell starts so."""
    words = ["sh", "-c", f'exec "$@" {streams}', "sh", *map(str, command)]
    return subprocess.run(words, timeout=300, check=False).returncode


@pytest.mark.parametrize("streams", CLOSED)
def test_an_environment_runs_and_nobody_prints_into_it(tmp_path: Path, streams: str) -> None:
    said = tmp_path / "said"
    without(streams, sys.executable, "-c", _PROGRAM, sample("counter"), said)
    told = json.loads(said.read_text())
    assert told["missing"] == CLOSED[streams]
    assert "error" not in told, told["error"]
    assert told["shape"] == [2, 3]


def test_a_command_runs() -> None:
    command = [sys.executable, "-I", "-m", "envhub_sandbox", "inspect", sample("counter")]
    assert without("2>&-", *command) == 0


def test_a_server_has_nothing_of_its_own_there(tmp_path: Path) -> None:
    """What a library prints into it would otherwise go into a lock, or wake its loop."""
    state = tmp_path / "state"
    command = [*WORKER, "listen", "--bind", "tcp://127.0.0.1:*", "--state-dir", str(state)]
    words = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *command]
    with subprocess.Popen(words) as server:
        try:
            assert eventually(lambda: noted(state) or server.poll() is not None)
            assert server.poll() is None
            assert [os.readlink(f"/proc/{server.pid}/fd/{number}") for number in range(3)] == [
                os.devnull
            ] * 3
        finally:
            server.terminate()


def noted(state: Path) -> bool:
    """Whether a server says on its machine where it listens."""
    note = state / "endpoint"
    return note.exists() and bool(note.read_text())
