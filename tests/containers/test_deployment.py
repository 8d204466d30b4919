"""The lines and files of ``examples/deployment``, run as they are written."""

import os
import re
import secrets
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml

from envhub_sandbox import RemoteSandbox, make_env
from envhub_sandbox.errors import WorkerDiedError
from envhub_sandbox.extras.docker.engines import Engine
from tests.containers.kit import IMAGE
from tests.support.ports import lasting_port
from tests.support.processes import eventually
from tests.support.samples import sample

CHECKOUT = Path(__file__).resolve().parents[2]
DEPLOYMENT = CHECKOUT / "examples" / "deployment"
_STATE = "/var/lib/envhub-worker"


def wait_until_it_serves(engine: Engine, container: str) -> None:
    health = [engine.command, "exec", container, "envhub-worker", "health"]

    def serves() -> bool:
        return subprocess.run(health, capture_output=True).returncode == 0

    assert eventually(serves), engine.run("logs", container)
    assert eventually(lambda: "ENVHUB_SERVER_KEY" in engine.run("logs", container))


def client_of(engine: Engine, container: str, port: int) -> RemoteSandbox:
    """The one client that a server of ours made a key for, once it serves."""
    wait_until_it_serves(engine, container)
    keys = [
        engine.run("exec", container, "cat", f"{_STATE}/{name}").split()[0]
        for name in ("server.pub", "client.key")
    ]
    return RemoteSandbox(f"tcp://127.0.0.1:{port}", server_key=keys[0], client_key=keys[1])


def goes_on(engine: Engine, container: str, port: int, restart: Callable[[], object]) -> None:
    """A client's environment outlives its server, and has every layer before and after."""
    remote = client_of(engine, container, port)
    policy = {"restart": "on_reset"}
    with make_env(sample("counter"), sandbox=remote, policy=policy) as suites:
        env = suites.env
        first, _ = env.reset(seed=1)
        action = env.action_space.sample()
        after = env.step(action)[0]
        restart()
        assert client_of(engine, container, port) == remote
        with pytest.raises(WorkerDiedError):
            env.step(action)
        assert np.array_equal(env.reset(seed=1)[0], first)
        assert np.array_equal(env.step(action)[0], after)
        held = {layer["layer"] for layer in env.sandbox.report() if layer["enforced"]}
        assert {"user-namespace", "mount-namespace", "landlock", "seccomp"} <= held


def documented() -> str:
    """The locked-down line, out of the page that people copy it from."""
    page = (CHECKOUT / "docs" / "deployment.md").read_text()
    [line] = [
        block
        for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
        if "seccomp=" in block and "docker run" in block
    ]
    return line


@contextmanager
def volume(engine: Engine) -> Iterator[str]:
    """A name that no other volume or container has."""
    name = f"envhub-test-{secrets.token_hex(6)}"
    try:
        yield name
    finally:
        engine.run("rm", "--force", name)
        engine.run("volume", "rm", "--force", name)


def test_the_documented_line_keeps_its_clients(engine: Engine) -> None:
    """Run twice, with an end between: the same keys, and a client that goes on."""
    port = lasting_port()
    with volume(engine) as name:
        line = documented()
        for what, instead in (
            ("docker run --rm", f"{engine.command} run --rm --detach --name {name}"),
            ("127.0.0.1:5555:5555", f"127.0.0.1:{port}:5555"),
            ("--volume envhub-worker:", f"--volume {name}:"),
            (" envhub-worker\n", f" {IMAGE}\n"),
        ):
            assert line.count(what) == 1, what
            line = line.replace(what, instead)
        if engine.kind == "podman":
            line = line.replace("systempaths=unconfined", "unmask=ALL")

        def start() -> None:
            subprocess.run(["bash", "-euc", line], cwd=CHECKOUT, check=True, timeout=120)

        def restart() -> None:
            engine.run("stop", name)
            assert eventually(lambda: name not in engine.run("ps", "--all"))
            start()

        start()
        goes_on(engine, name, port, restart)


def test_without_a_volume_a_read_only_container_serves_and_forgets(engine: Engine) -> None:
    """Its keys are new at each start, as its page says: what the line before is the cure for."""
    options = ("--read-only", "--tmpfs", "/tmp")
    found = set[str]()
    for _ in range(2):
        container = engine.run("run", "--rm", "--detach", *options, IMAGE).strip()
        try:
            wait_until_it_serves(engine, container)
            said = re.search(r"public key: (\w{64})", engine.run("logs", container))
            found.add(said[1])
        finally:
            engine.run("rm", "--force", container)
    assert len(found) == 2


def test_the_compose_file_keeps_its_clients(engine: Engine, tmp_path: Path) -> None:
    """``up``, ``restart``, and ``down`` and ``up``, from a folder that is not its own."""
    compose = [engine.command, "compose"]
    if subprocess.run([*compose, "version"], capture_output=True).returncode != 0:
        pytest.skip("needs docker compose")
    port, project = lasting_port(), f"envhub-test-{secrets.token_hex(6)}"
    settings = {"ENVHUB_IMAGE": IMAGE, "ENVHUB_PUBLISH": f"127.0.0.1:{port}"}
    command = [*compose, "--project-name", project, "--file", str(DEPLOYMENT / "compose.yaml")]

    def run(*words: str) -> str:
        done = subprocess.run(
            [*command, *words],
            cwd=tmp_path,
            env={**os.environ, **settings},
            capture_output=True,
            text=True,
            timeout=180,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    def down_and_up() -> None:
        run("down")
        run("up", "--detach")

    try:
        run("up", "--detach")
        name = f"{project}-envhub-worker-1"
        goes_on(engine, name, port, lambda: run("restart"))
        goes_on(engine, name, port, down_and_up)
    finally:
        run("down", "--volumes")


@pytest.mark.parametrize("version", ["1.30", "1.37"])
def test_the_pods_of_the_ray_cluster_fit_kubernetes(version: str, tmp_path: Path) -> None:
    """Its own schemas know no RayCluster, and each pod that this makes; and what else is there."""
    if shutil.which("kubernetes-validate") is None:
        pytest.skip("needs kubernetes-validate")

    def code(*documents: object) -> int:
        path = tmp_path / "manifests.yaml"
        path.write_text(yaml.safe_dump_all(documents))
        words = ["kubernetes-validate", "--strict", "--kubernetes-version", version, str(path)]
        return subprocess.run(words, capture_output=True, timeout=60).returncode

    *others, cluster = sorted(
        yaml.safe_load_all((DEPLOYMENT / "ray.yaml").read_text()),
        key=lambda one: one["kind"] == "RayCluster",
    )
    groups = [cluster["spec"]["headGroupSpec"], *cluster["spec"]["workerGroupSpecs"]]
    named = {"apiVersion": "v1", "kind": "Pod"}
    pods = [named | one["template"] | {"metadata": {"name": "pod"}} for one in groups]
    assert (len(pods), code(*others, *pods)) == (2, 0)
    pods[1]["spec"]["hostUser"] = pods[1]["spec"].pop("hostUsers")
    assert code(*others, *pods) != 0


@pytest.mark.parametrize("manifests", ["kubernetes.yaml", "fleet.yaml"])
@pytest.mark.parametrize("version", ["1.30", "1.37"])
def test_the_manifests_fit_kubernetes(version: str, manifests: str, tmp_path: Path) -> None:
    """By its own schemas, where a field that is misspelt, or of another type, is refused."""
    if shutil.which("kubernetes-validate") is None:
        pytest.skip("needs kubernetes-validate")
    good = (DEPLOYMENT / manifests).read_text()
    texts = [good]
    for part, instead in (
        ("readOnlyRootFilesystem", "readonlyRootFilesystem"),
        ("replicas: ", "replicas: one"),
        ("policyTypes: [Ingress, Egress]", "policyTypes: Ingress"),
    ):
        assert part in good
        texts.append(good.replace(part, instead))
    codes = []
    for text in texts:
        path = tmp_path / "manifests.yaml"
        path.write_text(text)
        words = ["kubernetes-validate", "--strict", "--kubernetes-version", version, str(path)]
        codes.append(subprocess.run(words, capture_output=True, timeout=60).returncode)
    assert codes[0] == 0
    assert all(codes[1:])
