"""The monitor of a container, with a script for an engine."""

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.support import inside
from tests.support.processes import eventually

_ENGINE = """#!/bin/sh
cd {folder}
echo "$@" >>{log}
[ "$1" = run ] || exit 0
echo $$ >{log}.pid
{what}
"""
_ANNOUNCES = """echo '{"envhub-worker": "0"}'"""
_SERVES = f"echo 'WARNING: something that engines say' >&2; {_ANNOUNCES}; cat >/dev/null"


@dataclass
class Kept:
    """A monitor that runs, the document that it wrote, and the log of calls of its engine."""

    monitor: subprocess.Popen[bytes]
    client: subprocess.Popen[bytes]
    said: dict[str, object]
    folder: Path
    log: Path

    def ends(self) -> bool:
        self.monitor.wait(60)
        calls = self.log.read_text().splitlines()
        return not self.folder.exists() and calls[-1] == "rm --force --volumes envhub-test"


@contextlib.contextmanager
def kept(tmp_path: Path, what: str, script: Path | None = None) -> Iterator[Kept]:
    """A monitor whose engine does ``what`` when it is to run a container."""
    folder, log, engine = tmp_path / "folder", tmp_path / "calls", tmp_path / "engine"
    folder.mkdir()
    engine.write_text(_ENGINE.format(folder=tmp_path, log=log, what=what))
    engine.chmod(0o755)
    client = subprocess.Popen([sys.executable, "-S", "-c", "input()"], stdin=subprocess.PIPE)
    pidfd, (ready, ready_end) = os.pidfd_open(client.pid), os.pipe()
    words = [str(pidfd), str(ready_end), str(folder), "envhub-test", "--", str(engine), "run"]
    monitor = subprocess.Popen(
        [sys.executable, "-I", "-S", str(script or inside.monitor_script()), *words],
        pass_fds=(pidfd, ready_end),
    )
    os.close(ready_end)
    os.close(pidfd)
    try:
        assert select.select([ready], [], [], 60)[0]
        yield Kept(monitor, client, json.loads(os.read(ready, 65536)), folder, log)
    finally:
        os.close(ready)
        monitor.kill()
        monitor.wait()
        client.communicate()


@pytest.mark.parametrize("how", ["the client exits", "the client is killed", "it is told to"])
def test_the_container_ends_with_its_client(tmp_path: Path, how: str) -> None:
    with kept(tmp_path, _SERVES) as made:
        assert made.said == {"envhub-worker": "0"}
        if how == "it is told to":
            made.monitor.terminate()
        elif how == "the client is killed":
            made.client.kill()
        else:
            made.client.communicate()
        assert made.ends()


@pytest.mark.parametrize("code", [0, 137])
def test_the_monitor_ends_as_its_container_did(tmp_path: Path, code: int) -> None:
    """So that the client can tell how that was: 137 is SIGKILL inside."""
    with kept(tmp_path, f"{_ANNOUNCES}; exit {code}") as made:
        assert made.ends()
        assert made.monitor.returncode == code


def test_the_lifeline_is_cut_when_the_monitor_is_killed(tmp_path: Path) -> None:
    with kept(tmp_path, _SERVES) as made:
        pid = int((tmp_path / "calls.pid").read_text())
        made.monitor.send_signal(signal.SIGKILL)
        assert eventually(lambda: not os.path.exists(f"/proc/{pid}"))


def test_an_engine_that_fails_is_quoted(tmp_path: Path) -> None:
    with kept(tmp_path, "seq 5000; echo 'no such runtime' >&2; exit 125") as made:
        assert made.said["ended"] == 125
        assert str(made.said["tail"]).endswith("4999\n5000\nno such runtime\n")
        assert len(str(made.said["tail"])) <= 8192
        assert made.ends()


def test_what_a_server_says_later_is_read_and_dropped(tmp_path: Path) -> None:
    """So that it does not wait for a reader."""
    talked = tmp_path / "calls.talked"
    with kept(tmp_path, f"{_ANNOUNCES}; head -c 3000000 /dev/zero; echo >{talked}; cat") as made:
        assert eventually(talked.exists)
        made.monitor.terminate()
        assert made.ends()


def test_a_container_that_ignores_the_end_of_its_stdin_is_removed(tmp_path: Path) -> None:
    text = inside.monitor_script().read_text()
    script = tmp_path / "monitor.py"
    script.write_text(text.replace("\n_END_S = 8.0\n", "\n_END_S = 0.2\n"))
    assert script.read_text() != text
    with kept(tmp_path, f"{_ANNOUNCES}; exec sleep 300", script) as made:
        made.monitor.terminate()
        assert made.ends()
