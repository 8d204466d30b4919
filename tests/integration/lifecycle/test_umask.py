"""Everything works under every umask, as whoever runs it; what is private stays so."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from envhub_sandbox import make_env
from tests.remote.listening import WORKER, counting, listening
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
