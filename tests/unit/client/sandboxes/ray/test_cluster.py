"""What is believed of an actor's answer, and of Ray's own words."""

from __future__ import annotations

import concurrent.futures
import json
import pickle
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from envhub_sandbox.errors import PolicyError, SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.sandboxes.ray import cluster


@pytest.mark.parametrize(
    "lie",
    [
        *(b"", b"{", b"[]", b"7", b"null", b"{" * 70_000, b"[" * 30_000, b"\xff"),
        *({"endpoint": "x"}, "{}", None, 7, pickle.dumps({})),
        *(json.dumps({"log": "x" * 70_000}).encode(), type("Bytes", (bytes,), {})(b"{}")),
    ],
    ids=range(15),
)
def test_an_answer_that_is_none_is_refused(lie: Any) -> None:
    """Whatever Ray has made of it; nothing but JSON in bytes is read, and no subclass of these."""
    assert cluster.read_answer(b'{"code": 3}') == {"code": 3}
    with pytest.raises(WorkerStartupError, match="none of ours"):
        cluster.read_answer(lie)


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (b'{"code": 3, "log": "no\\nroom"}', "it ended with 3: no room"),
        (b'{"code": "\\u001b[2J", "log": "\\u001b[2J"}', r"it ended with \x1b[2J: \x1b[2J"),
        (b'{"code": "%s", "log": ""}' % (b"x" * 60_000), "it ended with xxx"),
        (b"nonsense", "none of ours"),
        (7, "none of ours"),
    ],
)
def test_how_a_server_ended_is_a_text(
    answer: Any, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the node says: it is short, does nothing to a terminal, and hides no other error."""
    ray = use(Ray(connected="a:1"), monkeypatch)
    placed = cluster.PlacedActor({})
    placed.watch(lambda: None)
    ray.waits.set_result(answer)
    text = placed.end_text(0)
    assert says in text
    assert len(text) < 5_000
    assert "\x1b" not in text


class Ray:
    """Stands for Ray: whether this process is connected, and what becomes of ``init``."""

    def __init__(self, *, running: bool = False, connected: str = "") -> None:
        self.running, self.connected = running, connected
        self.asked: list[str] = []
        self.waits: concurrent.futures.Future[Any] = concurrent.futures.Future()
        self.exceptions = SimpleNamespace(ActorUnavailableError=type("Busy", (Exception,), {}))

    def remote(self, **_: Any) -> Any:
        """An actor, which has been placed; ``waits`` is what its ``wait`` will have answered."""
        called = SimpleNamespace(future=lambda: self.waits)
        handle = SimpleNamespace(wait=SimpleNamespace(remote=lambda: called))
        placed = SimpleNamespace(remote=lambda: handle)
        return lambda actor: SimpleNamespace(options=lambda **_: placed)

    def is_initialized(self) -> bool:
        return bool(self.connected)

    def init(self, address: str, **_: Any) -> None:
        """Fails as Ray does, where no cluster runs."""
        self.asked.append(address)
        if address != "local" and not self.running:
            raise ConnectionError("Could not find\x1b any running Ray instance")
        self.connected = f"{address}:1"

    def get_runtime_context(self) -> Any:
        """With the address that it is connected to."""
        return SimpleNamespace(gcs_address=self.connected, get_job_id=lambda: "01000000")

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0}


def use(ray: Ray, monkeypatch: pytest.MonkeyPatch) -> Ray:
    monkeypatch.setitem(sys.modules, "ray", ray)  # type: ignore[arg-type]
    monkeypatch.setattr(cluster, "check_installed", lambda: None)
    return ray


def test_a_local_ray_is_started_where_none_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which is said, once. One that runs is used without a word; none is started in its place."""
    ray = use(Ray(), monkeypatch)
    with pytest.warns(RuntimeWarning, match=r"a local Ray with 2 CPUs was started"):
        cluster.connect()
    cluster.connect()
    assert ray.asked == ["auto", "local"]
    assert (cluster.cpus(), cluster.shared_address(), cluster.job()) == (2, "local:1", "01000000")
    ray = use(Ray(running=True), monkeypatch)
    assert cluster.job() is None
    cluster.connect()
    assert ray.asked == ["auto"]
    ray = use(Ray(), monkeypatch)
    with pytest.raises(SandboxUnavailableError, match=r"10\.0\.0\.1:6379.*\\x1b"):
        cluster.connect("10.0.0.1:6379")
    assert ray.asked == ["10.0.0.1:6379"]


def test_another_cluster_than_the_connected_one_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    use(Ray(connected="10.0.0.1:6379"), monkeypatch)
    for good in ("", "auto", "10.0.0.1:6379"):
        cluster.connect(good)
    with pytest.raises(PolicyError, match=r"10\.0\.0\.1:6379"):
        cluster.connect("10.0.0.2:6379")
