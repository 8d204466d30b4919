"""The command line against a Hub: what is fetched, what is said, and how it ends."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
from pathlib import Path

import pytest

from tests.hub.olah_server import OlahServer
from tests.support.command_line import COMMAND, envhub
from tests.support.samples import EXAMPLES

pytestmark = pytest.mark.same_for("users")


@pytest.fixture
def hub(olah: OlahServer, hub_cache: Path) -> list[str]:
    return ["--endpoint", olah.endpoint, "--hub-cache-dir", str(hub_cache)]


def test_a_repository_of_the_hub_runs(
    olah: OlahServer, hub: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The commit is in the provenance, nothing but results is printed, and then it needs no Hub."""
    code = (EXAMPLES / "cartpole" / "env.py").read_text()
    commit = olah.repository("org/cli-runs", "model").commit({"env.py": code})
    named = envhub("run", "org/cli-runs@main", "--episodes", "2", *hub)
    assert (named.returncode, named.stderr) == (0, "")
    assert f"org/cli-runs (model) at {commit}, env.py" in named.stdout
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    pinned = envhub("run", f"org/cli-runs@{commit}", "--episodes", "2", "--json", *hub)
    assert json.loads(pinned.stdout)["provenance"]["commit"] == commit
    listed = envhub("cache", "list", "--json")
    assert [one["commit"] for one in json.loads(listed.stdout)["snapshots"]] == [commit]


def test_ctrl_c_ends_a_download_that_hangs(hub_cache: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        endpoint = f"http://127.0.0.1:{silent.getsockname()[1]}"
        arguments = ["run", "org/repo", "--endpoint", endpoint, "--hub-cache-dir", str(hub_cache)]
        with subprocess.Popen(
            [*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            silent.settimeout(60)
            connection, _ = silent.accept()
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=60)
            connection.close()
    assert (process.returncode, out, err) == (130, "", "Interrupted.\n")
