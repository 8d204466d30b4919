"""A container by a port or by mounts, with a program for an engine that makes none."""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from envhub_sandbox import errors
from envhub_sandbox.extras.docker import attestation, engines, published, run_arguments
from envhub_sandbox.extras.docker.container import RepositoryContainer
from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.extras.docker.packages import BuiltImageTarget, ImageTarget
from envhub_sandbox.extras.docker.published import PublishedContainer
from envhub_sandbox.extras.docker.sandbox import DockerSandbox
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.runtime import Runtime
from tests.support.processes import descendants, eventually
from tests.unit.client.sandboxes.docker.test_run_arguments import DOCKER, PODMAN, SAID, WANTED

_KEY = "00" * 32
_ENGINE = """#!{python} -S
import json, socket, sys
given = dict(zip(sys.argv, sys.argv[1:]))
what = "{what}"
if sys.argv[1] == "port":
    others = {{"publishes elsewhere": "0.0.0.0:4711", "publishes nothing": ""}}
    print(others.get(what, "127.0.0.1:9"))
    sys.exit()
if what == "fails":
    print("no such runtime")
    sys.exit(125)
mounted = [word for word in sys.argv if '"dst=/run/envhub"' in word]
if mounted and what != "shares nothing":
    folder = mounted[0].split('"src=')[1].partition('"')[0]
    sockets = [socket.socket(socket.AF_UNIX) for _ in range(2)]
    for one, name in zip(sockets, ("server", "fds")):
        one.bind(folder + "/" + name)
said = {{
    "envhub-worker": "0", "profiles": ["container"], "landlock": 7, "capabilities": 0,
    "user": int(given["--user"].partition(":")[0]), "no_new_privileges": True, "seccomp": True,
    "read_only": what != "is open", "devices": ["lo"] if mounted else ["lo", "eth0"],
    "memory": int(given["--memory"]), "pids": int(given["--pids-limit"]),
    "cpus": float(given["--cpus"]), "python": "",
}}
if not mounted:
    print("Unable to find something")
    said |= {{}} if what == "has no key" else {{"server_key": "{key}"}}
print(json.dumps(said), flush=True)
sys.stdin.read()
"""
PUBLISHED = replace(
    WANTED, sockets="", snapshot="", readable=(), user=(65532, 65532), only_client=_KEY
)


@pytest.fixture
def temporary(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder for temporary files, of a short name."""
    with tempfile.TemporaryDirectory(prefix="eh") as folder:
        monkeypatch.setattr(tempfile, "tempdir", folder)
        yield Path(folder)


@pytest.fixture
def sandbox(tmp_path: Path) -> Callable[..., Any]:
    def made(what: str, *, mounts: bool = False) -> PublishedContainer | RepositoryContainer:
        program = tmp_path / "docker"
        program.write_text(_ENGINE.format(python=sys.executable, what=what, key=_KEY))
        program.chmod(0o755)
        engine = Engine("docker", str(program), "28", rootless=False, machine="aarch64", cpus=3)
        kind = RepositoryContainer if mounts else PublishedContainer
        return kind(DockerSandbox(published=not mounts), engine, "sha256:0", tmp_path, Policy())

    return made


def test_the_command_line_is_that_of_one_that_is_mounted_but_for_its_network() -> None:
    """Word for word: what stands here is what confines, and what others on the machine can see."""
    words = run_arguments.run_arguments(DOCKER, PUBLISHED)
    mounted = run_arguments.run_arguments(DOCKER, WANTED)
    assert words[: words.index("--network")] == mounted[: mounted.index("--network")]
    network = words.index("--network")
    assert words[network : network + 4] == ["--network", "bridge", "--publish", "127.0.0.1::5555"]
    confines = slice(mounted.index("--read-only"), mounted.index("--mount"))
    expected = [word.replace("1000:1000", "65532:65532") for word in mounted[confines]]
    assert words[network + 4 :] == [
        *expected,
        *("--mount", "type=volume,dst=/var/lib/envhub-worker", "sha256:1"),
        *("listen", "--bind", "tcp://0.0.0.0:5555", "--only-client", _KEY),
        *("--log-level", "warning", "--until-eof", "--announce"),
    ]


def test_a_policy_is_permitted_there() -> None:
    words = run_arguments.run_arguments(
        PODMAN, replace(PUBLISHED, network="host", gpus="all", profile="container")
    )
    assert words[words.index("--network") + 1] == "bridge"
    assert "keep-id" not in words
    assert words[words.index("warning") + 1 :] == [
        *("--weakest-profile", "container", "--allow-network", "--allow-gpu"),
        *("--until-eof", "--announce"),
    ]


def test_the_report_says_that_there_is_a_network() -> None:
    said = {**SAID, "user": 65532, "devices": ["lo", "eth0"]}
    found = attestation.parse(json.dumps(said).encode())
    rows = {row["layer"]: row["enforced"] for row in attestation.layers(PUBLISHED, found, "title")}
    assert rows["container-network"] is False
    assert rows["container-user"] is rows["container-files"] is True


def test_a_container_serves_until_it_is_given_back(
    sandbox: Callable[..., Any], temporary: Path, tmp_path: Path
) -> None:
    """Its processors are the engine's; then its process and its folder are gone."""
    before = descendants()
    use = sandbox("serves").acquire(tmp_path)
    server = use.server
    assert isinstance(server, published.PublishedServer)
    assert (server.endpoint, server.profile) == ("tcp://127.0.0.1:9", "container")
    assert server.is_ours
    assert server.far.server_key == bytes(32)
    details = {row["layer"]: row["detail"] for row in server.layers}
    assert details["container-cpus"] == "the time of 3 processors"
    [folder] = temporary.iterdir()
    assert "SCMP_ARCH_AARCH64" in (folder / "seccomp.json").read_text()
    assert server.runs
    use.release()
    assert not server.runs
    assert not list(temporary.iterdir())
    assert eventually(lambda: not descendants() - before)
    server.stop()  # idempotent


@pytest.mark.parametrize(
    ("what", "mounts", "kind", "text"),
    [
        ("fails", False, errors.SandboxUnavailableError, "no such runtime"),
        ("is open", False, errors.SandboxUnavailableError, "container-files does not hold"),
        ("has no key", False, errors.WorkerStartupError, "build the image again"),
        ("publishes elsewhere", False, errors.SandboxUnavailableError, "does not publish"),
        ("publishes nothing", False, errors.SandboxUnavailableError, "does not publish"),
        ("fails", True, errors.EnvHubError, "no such runtime"),
        ("is open", True, errors.EnvHubError, "container-files"),
        ("shares nothing", True, errors.EnvHubError, "whose socket this process cannot use"),
    ],
)
def test_what_does_not_start_leaves_nothing(
    sandbox: Callable[..., Any],
    temporary: Path,
    tmp_path: Path,
    what: str,
    mounts: bool,
    kind: type[Exception],
    text: str,
) -> None:
    """And says why; a port that other machines could reach is none."""
    before = descendants()
    with pytest.raises(kind, match=text):
        sandbox(what, mounts=mounts).acquire(tmp_path)
    assert not list(temporary.iterdir())
    assert eventually(lambda: not descendants() - before)


def test_a_fork_does_not_keep_a_container(sandbox: Callable[..., Any], tmp_path: Path) -> None:
    use = sandbox("serves").acquire(tmp_path)
    fork = os.fork()
    if fork == 0:
        use.server.stop()
        time.sleep(3600)
        os._exit(0)
    try:
        assert use.server.runs
        use.release()
        assert not use.server.runs
    finally:
        os.kill(fork, 9)
        os.waitpid(fork, 0)


def test_an_engine_in_a_virtual_machine_says_what_that_has() -> None:
    """Other engines than this machine's have other processors; a pipe of Windows is here."""
    assert published.seccomp_profile("arm64")["architectures"] == ["SCMP_ARCH_AARCH64"]
    with pytest.MonkeyPatch.context() as patch:
        for host, elsewhere in (("npipe:////./pipe/docker_engine", False), ("ssh://there", True)):
            patch.setenv("DOCKER_HOST", host)
            assert engines.is_elsewhere("docker") is elsewhere


def test_nothing_of_this_machine_is_mounted(tmp_path: Path) -> None:
    """Packages become an image; a path is refused before the engine is asked for anything."""
    assert isinstance(DockerSandbox(published=True).package_target(), BuiltImageTarget)
    assert type(DockerSandbox().package_target()) is ImageTarget
    policy = Policy(readable=("/data",))
    with pytest.raises(errors.PolicyError, match="put what is needed into the repository"):
        DockerSandbox(published=True).for_repository(tmp_path, policy, Runtime(""))


# --- with mounts, in place of a port


def test_a_mounted_one_serves_until_given_back(sandbox: Callable[..., Any], tmp_path: Path) -> None:
    """Its layers are those that hold; then its processes and its folder are gone."""
    before = descendants()
    use = sandbox("serves", mounts=True).acquire(tmp_path)
    server = use.server
    assert server.runs
    assert server.profile == "container"
    assert all(layer["enforced"] for layer in server.layers)
    use.release()
    assert not server.folder.exists()
    assert eventually(lambda: descendants() <= before)


def test_an_order_names_assets_as_they_lie_inside(sandbox: Callable[..., Any]) -> None:
    place = replace(sandbox("serves", mounts=True), assets=(Path("/c/a"), Path("/c/b")))
    own, *others = (("models--org--r", "", ""), ("datasets--a--b", "/c/b", "asset-1"))
    copies = tuple((name, "a" * 40, ("main",), tree) for name, tree, _ in (own, *others))
    order = m.OpenJail("x", "", "", "/c/own", "env.py", {}, 1, hub_copies=copies)
    server = SimpleNamespace(python="", profile="strict")
    made = place.prepare(order, server, None, Deadline(1))
    assert made.snapshot == "/snapshots/this"
    assert [copy.tree for copy in made.repositories] == ["", "/snapshots/asset-1"]
