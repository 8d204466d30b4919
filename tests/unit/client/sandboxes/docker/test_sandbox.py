"""A container from its start to its end, with a program for an engine that makes none."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.sandboxes.docker.container import RepositoryContainer
from envhub_sandbox.sandboxes.docker.engines import Engine
from envhub_sandbox.sandboxes.docker.sandbox import DockerSandbox
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from tests.support.processes import descendants, eventually

_ENGINE = """#!{python} -S
import json, socket, sys
given = dict(zip(sys.argv, sys.argv[1:]))
if "{what}" == "fails":
    print("no such runtime")
    sys.exit(125)
mount = next(word for word in sys.argv if '"dst=/run/envhub"' in word)
folder = mount.split('"src=')[1].partition('"')[0]
sockets = [socket.socket(socket.AF_UNIX) for _ in range(2)]
for one, name in zip(sockets, ("server", "fds")):
    "{what}" == "shares nothing" or one.bind(folder + "/" + name)
print(json.dumps({{
    "envhub-worker": "0", "profiles": ["container"], "landlock": 7, "capabilities": 0,
    "user": int(given["--user"].partition(":")[0]), "no_new_privileges": True, "seccomp": True,
    "read_only": "{what}" != "is open", "devices": ["lo"], "memory": int(given["--memory"]),
    "pids": int(given["--pids-limit"]), "cpus": float(given["--cpus"]), "python": "",
}}), flush=True)
sys.stdin.read()
"""


def sandbox(folder: Path, what: str) -> RepositoryContainer:
    """That of a repository whose engine does this."""
    program = folder / "docker"
    program.write_text(_ENGINE.format(python=sys.executable, what=what))
    program.chmod(0o755)
    engine = Engine("docker", str(program), "28", rootless=False)
    return RepositoryContainer(DockerSandbox(), engine, "sha256:0", folder, Policy())


def test_a_container_serves_until_it_is_given_back(tmp_path: Path) -> None:
    """Its layers are those that hold; then its processes and its folder are gone."""
    before = descendants()
    use = sandbox(tmp_path, "serves").acquire(tmp_path)
    server = use.server
    assert server.runs
    assert server.profile == "container"
    assert all(layer["enforced"] for layer in server.layers)
    use.release()
    assert not server.folder.exists()
    assert eventually(lambda: descendants() <= before)


def test_an_order_names_assets_as_they_lie_inside(tmp_path: Path) -> None:
    place = replace(sandbox(tmp_path, "serves"), assets=(Path("/c/a"), Path("/c/b")))
    own, *others = (("models--org--r", "", ""), ("datasets--a--b", "/c/b", "asset-1"))
    copies = tuple((name, "a" * 40, ("main",), tree) for name, tree, _ in (own, *others))
    order = m.OpenJail("x", "", "", "/c/own", "env.py", {}, 1, hub_copies=copies)
    server = cast("Any", SimpleNamespace(python="", profile="strict"))
    made = place.prepare(order, server, cast("Any", None), Deadline(1))
    assert made.snapshot == "/snapshots/this"
    assert [copy.tree for copy in made.repositories] == ["", "/snapshots/asset-1"]


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("fails", "no such runtime"),
        ("shares nothing", "whose socket this process cannot use"),
        ("is open", "container-files"),
    ],
)
def test_a_start_that_fails_leaves_nothing(
    tmp_path: Path, what: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, place = descendants(), tmp_path / "t"
    place.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(place))
    with pytest.raises(EnvHubError, match=said):
        sandbox(tmp_path, what).acquire(tmp_path)
    assert os.listdir(place) == []
    assert eventually(lambda: descendants() <= before)
