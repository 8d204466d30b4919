"""A container that is reached by a port on loopback, as on macOS and Windows."""

import contextlib
import json
import os
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import RemoteSandbox, make_env
from envhub_sandbox.errors import PolicyError, SandboxUnavailableError, WorkerDiedError
from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.extras.docker.run_arguments import STATE
from envhub_sandbox.extras.docker.sandbox import DockerSandbox
from envhub_sandbox.extras.remote.tcp import new_keys
from envhub_worker.protocol.keys import key_text
from tests.containers.kit import IMAGE, container_of, folders, nothing_left
from tests.support import inside
from tests.support.elsewhere.kit import SYSTEMS, command, ran
from tests.support.processes import eventually
from tests.support.repositories import STILL, importing, write_repository
from tests.support.samples import sample
from tests.support.started import started

_QUIET = ("-p", "no:cacheprovider", "--capture=no", "-q", "-n", "0", "-k", "not asked_for")
_CLIENT = """
import json, os, sys
from envhub_sandbox import DockerSandbox, make_env
suites = make_env(sys.argv[1], n_envs=2, sandbox=DockerSandbox(image=sys.argv[2]))
env = suites.env
env.reset(seed=0)
env.step(env.action_space.sample())
print(json.dumps([layer["detail"] for layer in env.sandbox.report()][0]), flush=True)
if sys.argv[3] == "exit":
    sys.exit(0)
if sys.argv[3] == "fork" and os.fork() == 0:
    os.dup2(os.open(os.devnull, os.O_RDWR), 1)
sys.stdin.read()
"""
_REACHES = """
import socket, sys
try:
    socket.create_connection((sys.argv[1], int(sys.argv[2])), 10).sendall(b"reached")
except OSError as error:
    print(error)
"""
_NETWORKER = f"""{STILL}
import socket

class Networker(Still):
    def reach(self, host, port):
        try:
            socket.create_connection((host, port), 10).sendall(b"reached")
        except OSError as error:
            return str(error)
        return "reached"

def make_env(n_envs=1, use_async_envs=False):
    return vector(Networker, 1)
"""
_NEEDS_SIX = importing("six", version="six.__version__")


@pytest.fixture
def published(engine: Engine) -> DockerSandbox:
    return DockerSandbox(image=IMAGE, engine=engine.kind, published=True, build_network="host")


def inspected(engine: Engine, container: str) -> dict[str, Any]:
    return json.loads(engine.run("inspect", container))[0]


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_client_without_linux_gets_the_same_steps(system: str) -> None:
    """The compliance suite of containers, by ``DockerSandbox`` as it is by default there."""
    words = ("tests/containers/test_compliance.py", *_QUIET)
    done = ran(system, "-m", "pytest", *words, code=None, ENVHUB_TEST_IMAGE=IMAGE)
    assert done.returncode == 0, done.stdout[-6000:]
    assert " passed" in done.stdout


def test_it_is_shown_nothing_and_reached_from_here(
    published: DockerSandbox, engine: Engine
) -> None:
    """One volume without a name, a port on loopback, and no secret key in what others can see."""
    with started(sample("counter"), sandbox=published, seed=0) as env:
        container = container_of(env)
        known = inspected(engine, container)
        [mount] = known["Mounts"]
        assert (mount["Type"], mount["Destination"]) == ("volume", STATE)
        [[binding]] = known["NetworkSettings"]["Ports"].values()
        assert binding["HostIp"] == "127.0.0.1"
        far = inside.server(env).far
        secret = key_text(far.client_key)
        everything = json.dumps(known)
        assert secret not in everything
        assert far.public_key() in everything  # so a key would be found
        layers = {layer["layer"]: layer["enforced"] for layer in env.sandbox.report()}
        assert layers["container-network"] is False
        assert layers["container-user"] is layers["container-files"] is True
    assert nothing_left(engine)
    assert mount["Name"] not in engine.run("volume", "ls", "--quiet").split()
    assert folders() == []


def test_a_stranger_on_this_machine_is_not_let_in(published: DockerSandbox) -> None:
    """Who reaches the port and knows the server's key has none of the client's; that one is in."""
    with started(sample("counter"), sandbox=published, seed=0) as env:
        server = inside.server(env)
        own = key_text(server.far.client_key or b"")
        for key, comes_in in ((key_text(new_keys()[1]), False), (own, True)):
            other = RemoteSandbox(
                server.endpoint, server_key=key_text(server.far.server_key or b""), client_key=key
            )
            with contextlib.ExitStack() as stack:
                if not comes_in:
                    stack.enter_context(
                        pytest.raises(SandboxUnavailableError, match="does not know our key")
                    )
                made = stack.enter_context(make_env(sample("counter"), sandbox=other))
                made.env.reset(seed=0)
        env.step(env.action_space.sample())


@contextlib.contextmanager
def listener(address: str) -> Iterator[socket.socket]:
    """A service of this machine, where containers of a bridge can reach it."""
    with socket.create_server((address, 0)) as listening:
        listening.settimeout(15)
        yield listening


@pytest.mark.parametrize("profile", ["strict", "container"])
def test_no_jail_reaches_the_network_that_its_container_has(
    published: DockerSandbox, engine: Engine, tmp_path: Path, profile: str
) -> None:
    """The control runs beside it, in the same container, and reaches this machine."""
    repository = write_repository(tmp_path / "repo", _NETWORKER)
    policy = {"profile": profile}
    with make_env(repository, sandbox=published, policy=policy) as suites:
        env = suites.env
        env.reset()
        container = container_of(env)
        network = inspected(engine, container)["NetworkSettings"]["Networks"]["bridge"]
        with listener(network["Gateway"]) as listening:
            where = network["Gateway"], listening.getsockname()[1]
            python = "/opt/envhub-worker/bin/python"
            engine.run("exec", container, python, "-c", _REACHES, where[0], str(where[1]))
            connection, _ = listening.accept()
            with connection:
                assert connection.recv(7) == b"reached"
            [said] = env.call("reach", *where)
            assert said != "reached"
            listening.settimeout(0.5)
            with pytest.raises(TimeoutError):
                listening.accept()


@contextlib.contextmanager
def client(system: str, then: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    words = ("-c", _CLIENT, sample("counter"), IMAGE, then)
    process = subprocess.Popen(
        command(system, *words),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield process, json.loads(process.stdout.readline()).rpartition(", ")[2]
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.stdin.close()
        process.stdout.close()
        process.wait()


_ENDS = [(system, how) for system in SYSTEMS for how in ("exit", "SIGINT", "SIGKILL")]


@pytest.mark.parametrize(("system", "how"), [*_ENDS, ("darwin", "fork")])
def test_a_container_ends_with_its_client(engine: Engine, system: str, how: str) -> None:
    """Whatever ends the client; a fork of it that lives on does not keep the container."""
    before = set(engine.run("volume", "ls", "--quiet").split())
    with client(system, how if how in ("exit", "fork") else "wait") as (process, container):
        assert container.startswith("envhub-")
        if how != "exit":
            process.send_signal(signal.SIGKILL if how == "fork" else getattr(signal, how))
        process.wait()
        assert nothing_left(engine, process.pid)
        if how in ("exit", "SIGINT"):
            assert eventually(lambda: not folders(process.pid))
    assert eventually(lambda: set(engine.run("volume", "ls", "--quiet").split()) <= before)


def test_the_folder_of_a_killed_client_goes_with_the_next_start(engine: Engine) -> None:
    """It held the lock of a file there until it was killed."""
    with client("darwin", "wait") as (process, _):
        assert len(folders(process.pid)) == 1
        process.kill()
        process.wait()
        assert nothing_left(engine, process.pid)
    with client("darwin", "wait"):
        assert folders(process.pid) == []


def _step_on(env: Any) -> None:
    for _ in range(100_000):
        env.step(env.action_space.sample())


def test_a_killed_container_is_replaced(published: DockerSandbox, engine: Engine) -> None:
    """The step in between says so; the next reset starts another."""
    policy = {"restart": "on_reset"}
    with make_env(sample("counter"), sandbox=published, policy=policy) as suites:
        env = suites.env
        env.reset(seed=1)
        first = container_of(env)
        engine.run("kill", first)
        with pytest.raises(WorkerDiedError):
            _step_on(env)
        env.reset(seed=1)
        assert container_of(env) != first


def test_packages_are_in_an_image_of_their_own(
    published: DockerSandbox, engine: Engine, tmp_path: Path
) -> None:
    """Made once, for the image's Python, by the engine; not mounted from this machine."""
    folder = write_repository(tmp_path / "repo", _NEEDS_SIX, requirements__txt="six==1.17.0\n")
    made = set()
    try:
        for _ in range(2):
            with make_env(folder, sandbox=published) as suites:
                suites.env.reset(seed=0)
                assert suites.env.call("version") == ("1.17.0",)
                assert "six==1.17.0" in suites.provenance["installed"]["packages"]
                known = inspected(engine, container_of(suites.env))
                made.add(known["Image"])
                assert [mount["Type"] for mount in known["Mounts"]] == ["volume"]
        assert len(made) == 1
        base = json.loads(engine.run("image", "inspect", IMAGE))[0]["Id"]
        assert base not in made
    finally:
        assert nothing_left(engine)  # which would use it
        for image in made:
            engine.run("image", "rm", "--force", image)


def test_paths_of_this_machine_are_refused(published: DockerSandbox) -> None:
    with pytest.raises(PolicyError, match="put what is needed into the repository"):
        make_env(sample("counter"), sandbox=published, policy={"readable": ("/usr/share",)})
