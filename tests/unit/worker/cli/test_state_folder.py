"""What a server writes down for the commands of its machine, and who is believed."""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import pytest

from envhub_worker.extras.access.commands import state_folder, status
from envhub_worker.extras.access.commands.state_folder import Note, ServerNote

A = ServerNote("tcp://127.0.0.1:1", "insecure", "/a key")
B = ServerNote("tcp://127.0.0.1:2", "insecure", "/b")
_WRITER = """
import os, signal, sys
from pathlib import Path
from envhub_worker.extras.access.commands.state_folder import Note, ServerNote
Note(Path(sys.argv[1]), ServerNote("tcp://127.0.0.1:1", "insecure", "/a"))
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_it_is_there_as_long_as_its_server(tmp_path: Path) -> None:
    assert state_folder.read_note(tmp_path) is None
    ours = Note(tmp_path, A)
    assert state_folder.read_note(tmp_path) == A
    ours.remove()
    assert state_folder.read_note(tmp_path) is None
    assert os.listdir(tmp_path) == []


def test_that_of_killed_servers_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``status`` says at once that nobody is there, ``health`` looks on, ``listen`` replaces it."""
    tmp_path.chmod(0o700)
    worker = Path(state_folder.__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": str(worker)}
    subprocess.run([sys.executable, "-c", _WRITER, str(tmp_path)], env=environment, timeout=120)
    assert (tmp_path / "endpoint").exists()
    assert state_folder.read_note(tmp_path) is None
    assert status.status_is_healthy(tmp_path) is None
    asked = argparse.Namespace(state_dir=tmp_path, endpoint=None, json=False)
    assert status.run(asked) == 1
    assert f"is running here with the state folder {tmp_path};" in capsys.readouterr().err
    ours = Note(tmp_path, B)
    assert state_folder.read_note(tmp_path) == B
    ours.remove()


def test_a_server_removes_its_own(tmp_path: Path) -> None:
    first, second = Note(tmp_path, A), Note(tmp_path, B)
    first.remove()
    assert state_folder.read_note(tmp_path) == B
    second.remove()
    assert state_folder.read_note(tmp_path) is None


def test_others_state_folders_are_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The temporary folder is everybody's: what others may write there is none of ours. Jails are
    made elsewhere: a relative folder is where one stands."""
    monkeypatch.setenv("XDG_STATE_HOME", "/proc/nowhere")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = tmp_path / f"envhub-worker-{os.getuid()}"
    assert state_folder.state_dir(None, create=True) == folder
    folder.chmod(0o777)
    for create in (True, False):
        assert state_folder.state_dir(None, create=create) is None
    folder.rename(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").chmod(0o700)
    folder.symlink_to("elsewhere")
    assert state_folder.state_dir(None, create=True) is None
    monkeypatch.chdir(tmp_path)
    assert state_folder.state_dir(Path("here"), create=True) == tmp_path / "here"


def test_keys_are_kept_where_only_we_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = tmp_path / "chosen"
    chosen.mkdir(mode=0o700)
    assert state_folder.state_dir(chosen, create=True) == chosen
    chosen.chmod(0o720)
    with pytest.raises(PermissionError, match="mode 0720"):
        state_folder.state_dir(chosen, create=True)
    chosen.chmod(0o700)
    (tmp_path / "envhub-worker").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", "/proc/nowhere")
    assert state_folder.state_dir(None, create=False) == tmp_path / "envhub-worker"
    another = os.getuid() + 1
    monkeypatch.setattr("os.getuid", lambda: another)
    with pytest.raises(PermissionError, match="it belongs to uid"):
        state_folder.state_dir(chosen, create=True)
    assert state_folder.state_dir(None, create=False) is None
