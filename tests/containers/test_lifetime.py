"""However a client or a container ends, nothing of it remains; and nobody else's is touched."""

import collections
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import WorkerDiedError, WorkerStartupError
from envhub_sandbox.extras.docker import leftovers
from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.extras.docker.run_arguments import FOLDER_LABEL, USER_LABEL
from envhub_sandbox.extras.docker.sandbox import DockerSandbox
from envhub_sandbox.sandboxes.process import CONTAINER, RuntimeFolder
from tests.containers.kit import IMAGE, container_of, containers_of, folders, nothing_left, pids_in
from tests.support.processes import descendants, eventually
from tests.support.repositories import STILL, write_repository
from tests.support.samples import sample
from tests.support.started import started

_HOG = f"""{STILL}
class Hog(Still):
    def step(self, action):
        self.held = b"x" * (2 << 30)

def make_env(n_envs=1, use_async_envs=False):
    return vector(Hog, 1)
"""
_CLIENT = """
import json, os, sys
from envhub_sandbox import make_env
from envhub_sandbox.extras.docker.sandbox import DockerSandbox
docker = DockerSandbox(image=sys.argv[2], engine=sys.argv[3])
suites = make_env(sys.argv[1], n_envs=2, sandbox=docker)
env = suites.env
env.reset(seed=0)
env.step(env.action_space.sample())
report = [layer["detail"] for layer in env.sandbox.report() if layer["layer"] == "container"]
print(json.dumps({"report": report}), flush=True)
if sys.argv[4] == "exit":
    sys.exit(0)
if sys.argv[4] == "fork" and os.fork() == 0:
    os.dup2(os.open(os.devnull, os.O_RDWR), 1)
sys.stdin.read()
"""


@dataclass
class Client:
    """A client of its own process, which has a container."""

    process: subprocess.Popen[str]
    container: str

    def monitor(self) -> psutil.Process:
        [found] = [
            child
            for child in psutil.Process(self.process.pid).children(recursive=True)
            if any("monitor.py" in word for word in child.cmdline())
        ]
        return found


@contextlib.contextmanager
def client(engine: Engine, then: str = "wait") -> Iterator[Client]:
    words = [str(sample("counter")), IMAGE, engine.kind, then]
    process = subprocess.Popen(
        [sys.executable, "-c", _CLIENT, *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        said = json.loads(process.stdout.readline())
        container = said["report"][0].rpartition(", ")[2]
        yield Client(process, container)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.stdin.close()
        process.stdout.close()
        process.wait()


def test_closing_leaves_nothing(docker: DockerSandbox, engine: Engine) -> None:
    assert nothing_left(engine)  # of others that linger
    with started(sample("counter"), sandbox=docker, seed=0):
        assert (len(containers_of(engine, os.getpid())), len(folders())) == (1, 1)
    assert nothing_left(engine)
    assert folders() == []
    assert not [pid for pid in descendants() if "monitor.py" in _command(pid)]


def _command(pid: int) -> str:
    with contextlib.suppress(psutil.Error):
        return " ".join(psutil.Process(pid).cmdline())
    return ""


@pytest.mark.parametrize("how", ["exit", "SIGTERM", "SIGKILL"])
def test_a_container_ends_with_its_client(engine: Engine, how: str) -> None:
    with client(engine, "exit" if how == "exit" else "wait") as made:
        pids = [] if how == "exit" else pids_in(engine, made.container)
        if how != "exit":
            made.process.send_signal(getattr(signal, how))
        made.process.wait()
        assert nothing_left(engine, made.process.pid)
        assert eventually(lambda: not any(psutil.pid_exists(pid) for pid in pids))
        assert eventually(lambda: not folders(made.process.pid))


def test_a_fork_of_the_client_does_not_keep_its_container(engine: Engine) -> None:
    """The lifeline is held by nobody but the monitor: a child of the trainer may live on."""
    with client(engine, "fork") as made:
        assert eventually(lambda: len(_forks(made.process.pid)) == 1)
        [fork] = _forks(made.process.pid)
        made.process.kill()
        made.process.wait()
        assert nothing_left(engine, made.process.pid)
        assert psutil.pid_exists(fork)


def _forks(pid: int) -> list[int]:
    children = psutil.Process(pid).children()
    return [child.pid for child in children if "monitor.py" not in _command(child.pid)]


def test_client_and_monitor_killed_together_leave_no_container(engine: Engine) -> None:
    """The container's stdin ends with whoever held it; only a folder stays, for ``gc``."""
    with client(engine) as made:
        monitor = made.monitor()
        monitor.suspend()
        made.process.kill()
        monitor.kill()
        assert nothing_left(engine, made.process.pid)
        # a client that publishes a container removes what others have left, and may be first
        left = set(map(str, folders(made.process.pid)))
        for one in leftovers.find().leftovers:
            if one.name in left:
                one.remove()
        assert not folders(made.process.pid)


def test_a_killed_container_is_a_dead_worker(docker: DockerSandbox, engine: Engine) -> None:
    with started(sample("counter"), sandbox=docker, seed=0) as env:
        engine.run("kill", container_of(env))
        actions = env.action_space.sample()
        with pytest.raises(WorkerDiedError, match="counter"):
            collections.deque((env.step(actions) for _ in range(1000)), maxlen=0)
    assert nothing_left(engine)
    with started(sample("counter"), sandbox=docker, seed=0):
        pass


def test_tasks_of_a_repository_share_a_container(docker: DockerSandbox, engine: Engine) -> None:
    with make_env(sample("many_tasks"), sandbox=docker) as many:
        envs = [env for tasks in many.values() for env in tasks.values()][:3]
        for env in envs:
            env.reset(seed=0)
        assert len({container_of(env) for env in envs}) == 1
        with started(sample("counter"), sandbox=docker, seed=0) as other:
            assert container_of(other) != container_of(envs[0])


def test_environments_are_made_in_threads_at_once(docker: DockerSandbox) -> None:
    done = []

    def drive() -> None:
        with started(sample("counter"), sandbox=docker, seed=0) as env:
            done.append(env.step(env.action_space.sample()))

    threads = [threading.Thread(target=drive) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(done) == 3


@contextlib.contextmanager
def idle_container(engine: Engine, labels: dict[str, str]) -> Iterator[str]:
    words = [word for item in labels.items() for word in ("--label", "=".join(item))]
    name = engine.run("create", *words, IMAGE, "health").strip()
    try:
        yield name
    finally:
        with contextlib.suppress(Exception):
            engine.run("rm", "--force", name)


def test_gc_removes_what_is_ours_and_dead_and_nothing_else(engine: Engine) -> None:
    me = str(os.geteuid())
    with contextlib.ExitStack() as stack:
        kept = [RuntimeFolder(CONTAINER) for _ in range(2)]
        for one in kept:
            stack.callback(one.remove)
        alive, dead = [str(one.path) for one in kept]
        (kept[1].path / "alive").unlink()
        (kept[1].path / "alive").touch()
        made = {
            who: stack.enter_context(idle_container(engine, labels))
            for who, labels in {
                "dead": {FOLDER_LABEL: dead, USER_LABEL: me},
                "alive": {FOLDER_LABEL: alive, USER_LABEL: me},
                "elsewhere": {FOLDER_LABEL: "/tmp/envhub-docker-nothere0", USER_LABEL: me},
                "nonsense": {FOLDER_LABEL: "nonsense", USER_LABEL: me},
                "stranger": {"org.example": dead},
            }.items()
        }
        for found in leftovers.stale_containers(engine):
            assert found.remove()
        listed = engine.run("ps", "--all", "--no-trunc", "--format", "{{.ID}}").split()
        assert {who for who, name in made.items() if name in listed} == set(made) - {"dead"}


def test_a_containers_own_limit_is_said_to_be_one(engine: Engine, tmp_path: Path) -> None:
    """The policy permits the jail more than the container has: no signal out of nowhere."""
    write_repository(tmp_path / "hog", _HOG)
    sandbox = DockerSandbox(image=IMAGE, engine=engine.kind, memory=512 << 20)
    with started(tmp_path / "hog", sandbox=sandbox) as env:
        with pytest.raises(WorkerDiedError, match="memory limit around the server") as caught:
            env.step([1])
        assert caught.value.reason == "out-of-memory"


def test_too_little_memory_for_the_server_is_said_to_be_so(engine: Engine) -> None:
    sandbox = DockerSandbox(image=IMAGE, engine=engine.kind, memory=16 << 20)
    with pytest.raises(WorkerStartupError, match=r"has 16 MiB.*DockerSandbox\(memory="):
        make_env(sample("cartpole"), sandbox=sandbox)
