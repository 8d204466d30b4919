"""What is believed of an actor's answer, and of Ray's own words."""

import concurrent.futures
import copy
import json
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from envhub_sandbox import RaySandbox
from envhub_sandbox.errors import PolicyError, SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.extras.fleet.placement import Placement
from envhub_sandbox.extras.ray import cluster, sandbox
from envhub_sandbox.extras.ray.actor import WorkerActor
from envhub_sandbox.factory.make_env import sandbox_of
from envhub_sandbox.settings.policy import Policy
from envhub_worker.protocol.runtime import OWN, Runtime
from tests.support.command_line import runs
from tests.support.processes import eventually


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
    with pytest.raises(WorkerStartupError, match="of another program"):
        cluster.read_answer(lie)


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (b'{"code": 3, "log": "no\\nroom"}', "it ended with 3: no room"),
        (b'{"code": "\\u001b[2J", "log": "\\u001b[2J"}', r"it ended with \x1b[2J: \x1b[2J"),
        (b'{"code": "%s", "log": ""}' % (b"x" * 60_000), "it ended with xxx"),
        (b"nonsense", "of another program"),
        (7, "of another program"),
    ],
)
def test_how_servers_ended_is_text(answer: Any, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
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
        self.asked.append(address)
        if address != "local" and not self.running:
            raise ConnectionError("Could not find\x1b any running Ray instance")
        self.connected = f"{address}:1"

    def get_runtime_context(self) -> Any:
        return SimpleNamespace(gcs_address=self.connected, get_job_id=lambda: "01000000")

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0}


def use(ray: Ray, monkeypatch: pytest.MonkeyPatch) -> Ray:
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(cluster, "check_installed", lambda: None)
    return ray


def test_a_local_ray_is_started_where_none_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which is said, once. One that runs is used without a word; none is started in its place."""
    ray = use(Ray(), monkeypatch)
    with pytest.warns(RuntimeWarning, match=r"a local Ray with 2 CPUs was started"):
        cluster.connect()
    cluster.connect()
    assert ray.asked == ["auto", "local"]
    assert cluster.job() == "01000000"
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


# --- The actor of a node, in this process: it starts a server and says what has become of it


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


# --- What ``RaySandbox`` takes and refuses, and what it believes of what a node says


GOOD = {"endpoint": "tcp://10.0.0.3:4711", "key": "ab" * 32, "node": "0f" * 28, "gpus": [1, 0]}


@pytest.fixture
def with_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "check_installed", lambda: None)


@pytest.mark.parametrize(
    "lie",
    [
        *({"endpoint": one} for one in ("", "tcp://10.0.0.3", "ipc:///tmp/x", "tcp://a.b:1", 7)),
        *({"endpoint": f"tcp://{one}"} for one in ("10.0.0.3:1/x", "u:p@10.0.0.3:1", "*:1")),
        *({"endpoint": f"tcp://10.0.0.3:{one}"} for one in ("99999", "1;tcp://1.1.1.1:1")),
        *({"endpoint": f"tcp://[fe80::1%{one}]:1"} for one in ("\x1b[2J", "\u202e", "a\nb")),
        *({"key": one} for one in ("", "ab" * 31, None, ["ab" * 32])),
        *({"node": one} for one in ("", "x" * 65, "\x1b[2J", 3, "\u0663")),
        *({"gpus": one} for one in ([-1], ["0"], [True], None, 1, "", {}, [10**400])),
    ],
)
def test_a_lie_of_a_node_is_refused(lie: dict[str, Any]) -> None:
    """Before anything is connected to; each part is needed, and an address of IPv6 is one."""
    assert sandbox.read_started(GOOD) == (GOOD["endpoint"], b"\xab" * 32, GOOD["node"], (1, 0))
    on_six = GOOD | {"endpoint": "tcp://[fd00::3]:4711"}
    assert sandbox.read_started(on_six)[0] == "tcp://[fd00::3]:4711"
    with pytest.raises(WorkerStartupError, match="not started a worker server"):
        sandbox.read_started(GOOD | lie)
    with pytest.raises(WorkerStartupError):
        sandbox.read_started({name: GOOD[name] for name in GOOD if name not in lie})


@pytest.mark.parametrize(
    "options",
    [{"num_cpus": -1}, {"num_gpus": float("nan")}, {"resources": {"x": -1}}, {"placement_s": 0}],
)
def test_impossible_numbers_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(PolicyError, match="RaySandbox"):
        RaySandbox(**options)


@pytest.mark.usefixtures("with_ray")
@pytest.mark.parametrize(
    ("policy", "runtime", "says"),
    [
        (Policy(gpu=True), OWN, "num_gpus"),
        (Policy(gpu=(0,)), OWN, "Ray chooses the node"),
        (Policy(readable=("/data",)), OWN, "paths of this machine"),
        (Policy(), Runtime("/usr/bin/python3"), "interpreter of this machine"),
    ],
)
def test_what_a_node_cannot_give_is_refused(policy: Policy, runtime: Runtime, says: str) -> None:
    place = RaySandbox(num_gpus=0 if says == "num_gpus" else 1)
    with pytest.raises(PolicyError, match=says):
        place.for_repository(Path("/nowhere"), policy, runtime)


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(SandboxUnavailableError, match=r"envhub-sandbox\[ray\]"):
        RaySandbox().for_repository(Path("/nowhere"), Policy(), OWN)


def test_copies_have_the_options_and_none_of_the_servers() -> None:
    """Each is a place of its own, as env runners of RLlib get it; the name means one place."""
    place = RaySandbox(num_cpus=2, resources={"x": 1}, shared=True)
    for other in (copy.copy(place), copy.deepcopy(place), pickle.loads(pickle.dumps(place))):
        assert other is not place
        assert other != place
        options = {"num_cpus": 2, "num_gpus": 0.0, "resources": {"x": 1}}
        assert other.placement() == {**options, "scheduling_strategy": "SPREAD"}
        assert other.workers(4) == [other]  # it is shared
    assert len(sandbox.RAY.workers(4)) == 4


@pytest.mark.parametrize(("shared", "weights"), [(False, [1, 1, 1]), (True, [3])])
def test_each_place_of_a_list_is_another_server(shared: bool, weights: list[int]) -> None:
    places = [RaySandbox(shared=shared)] * 3
    members = Placement(places, lambda place: place, lambda member: OWN).members()
    assert [member.weight for member in members] == weights
    assert sandbox_of("ray") is sandbox_of("ray") is sandbox.RAY
