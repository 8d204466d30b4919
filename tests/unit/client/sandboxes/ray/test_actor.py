"""The actor of a node, in this process: it starts a server and says what has become of it."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from envhub_sandbox.sandboxes.ray.actor import WorkerActor
from tests.support.command_line import runs
from tests.support.processes import eventually


def node(**changes: Any) -> Any:
    said = {"address": "127.0.0.1", "gpus": [2], **changes}
    return SimpleNamespace(
        util=SimpleNamespace(get_node_ip_address=lambda: said["address"]),
        get_gpu_ids=lambda: said["gpus"],
        get_runtime_context=lambda: SimpleNamespace(get_node_id=lambda: "ab12"),
    )


@pytest.fixture
def servers() -> Iterator[list[psutil.Process]]:
    """Those that a test has started, which are ended."""
    before = set(psutil.Process().children())
    found: list[psutil.Process] = []
    yield found
    for process in set(psutil.Process().children()) - before:
        process.kill()
        process.wait(60)


@pytest.mark.usefixtures("servers")
def test_a_server_is_started_and_its_end_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """In plain data: where it listens, its public key, what Ray has assigned."""
    monkeypatch.setitem(sys.modules, "ray", node())
    actor, before = WorkerActor(), set(psutil.Process().children())
    said = json.loads(actor.start("ab" * 32))
    assert said["endpoint"].startswith("tcp://127.0.0.1:")
    assert len(bytes.fromhex(said["key"])) == 32
    assert (said["node"], said["gpus"]) == ("ab12", [2])
    [server] = set(psutil.Process().children()) - before
    assert runs(server)
    server.terminate()
    assert json.loads(actor.wait()) == {"code": 0, "log": ""}
    assert eventually(lambda: not runs(server))


@pytest.mark.usefixtures("servers")
@pytest.mark.parametrize(
    ("key", "changes", "says"),
    [
        ("no key", {}, "64 hexadecimal digits"),
        ("ab" * 32, {"address": "192.0.2.77"}, "--bind"),
        ("ab" * 32, {"gpus": ["GPU-1234"]}, "GPU-1234"),
    ],
)
def test_what_fails_is_a_text(
    monkeypatch: pytest.MonkeyPatch, key: str, changes: dict[str, Any], says: str
) -> None:
    monkeypatch.setitem(sys.modules, "ray", node(**changes))
    assert says in json.loads(WorkerActor().start(key))["error"]
