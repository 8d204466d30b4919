"""The image, and those that ``envhub image build`` derives from it for a repository."""

import contextlib
import json
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import RemoteSandbox, make_env
from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.extras.docker.sandbox import DockerSandbox
from tests.containers.kit import IMAGE
from tests.support.command_line import python
from tests.support.processes import eventually
from tests.support.samples import SAMPLES
from tests.support.started import started


def inspected(engine: Engine, image: str) -> dict[str, Any]:
    said: list[dict[str, Any]] = json.loads(engine.run("image", "inspect", image))
    return said[0]


def test_the_image_holds_the_worker_and_nothing_of_the_client(engine: Engine) -> None:
    code = "import importlib.util as u, sys; sys.exit(any(map(u.find_spec, sys.argv[1:])))"
    python = ("--entrypoint", "/opt/envhub-worker/bin/python", IMAGE, "-I", "-c", code)
    engine.run("run", "--rm", *python, "envhub_sandbox", "huggingface_hub", "typer", "torch")


def test_the_image_says_what_it_is(engine: Engine) -> None:
    config = inspected(engine, IMAGE)["Config"]
    assert (config["Entrypoint"], config["User"]) == (["envhub-worker"], "65532:65532")
    assert config["Healthcheck"]["Test"] == ["CMD", "envhub-worker", "health"]
    assert config["Labels"]["org.opencontainers.image.title"] == "envhub-worker"


def test_no_file_of_the_worker_can_be_changed_by_it(engine: Engine) -> None:
    """Even where a container is started without ``--read-only``."""
    words = ("--entrypoint", "find", IMAGE, "/opt", "-writable", "!", "-type", "l")
    assert engine.run("run", "--rm", *words).strip() == ""


@contextlib.contextmanager
def served(engine: Engine, *words: str) -> Iterator[RemoteSandbox]:
    """A container as a server for clients elsewhere; connected to by what it prints."""
    published = ("--publish", "127.0.0.1::5555")
    container = engine.run("run", "--rm", "--detach", *published, *words, IMAGE).strip()
    try:
        assert eventually(lambda: succeeds(engine, "exec", container, "envhub-worker", "health"))
        printed = engine.run("logs", container)
        keys = dict(re.findall(r'(server_key|client_key)="(\w+)"', printed))
        port = engine.run("port", container, "5555").split()[0].rpartition(":")[2]
        yield RemoteSandbox(f"tcp://127.0.0.1:{port}", **keys)
    finally:
        engine.run("rm", "--force", container)


def test_the_image_serves_at_once(engine: Engine) -> None:
    """As everybody would first try it: over TCP, with the keys that it prints."""
    with (
        served(engine) as remote,
        started(
            SAMPLES / "counter", sandbox=remote, policy={"profile": "container"}, seed=0
        ) as env,
    ):
        env.step(env.action_space.sample())


def test_a_hardened_container_gives_jails_every_layer(engine: Engine) -> None:
    """With the options and the profile of docs/deployment.md, the default policy can be had."""
    profile = SAMPLES.parent.parent / "examples" / "deployment" / "seccomp.json"
    hardened: tuple[str, ...] = ("--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL")
    for option in ("no-new-privileges", f"seccomp={profile}", "systempaths=unconfined"):
        hardened += ("--security-opt", option)
    with (
        served(engine, *hardened) as remote,
        started(SAMPLES / "counter", sandbox=remote, seed=0) as env,
    ):
        held = {layer["layer"] for layer in env.sandbox.report() if layer["enforced"]}
        assert {"mount-namespace", "pid-namespace", "landlock", "seccomp"} <= held


def succeeds(engine: Engine, *arguments: str) -> bool:
    nothing = subprocess.DEVNULL
    done = subprocess.run([engine.command, *arguments], stdout=nothing, stderr=nothing)
    return done.returncode == 0


@pytest.fixture(scope="module")
def derived(engine: Engine) -> Iterator[dict[str, Any]]:
    said = built(engine, SAMPLES / "minigrid")
    yield said
    engine.run("image", "rm", "--force", said["image"])


def built(engine: Engine, repository: Path, *options: str) -> dict[str, Any]:
    words = ("image", "build", repository, "--base", IMAGE, "--engine", engine.kind)
    done = python("-I", "-m", "envhub_sandbox", *words, "--build-network", "host", "--json")
    return dict(json.loads(done.stdout))


def test_a_repositorys_packages_are_in_its_image(derived: dict[str, Any], engine: Engine) -> None:
    """The jail runs in their interpreter; the worker's own image has none of them."""
    sandbox = DockerSandbox(image=derived["image"], engine=engine.kind)
    with make_env(SAMPLES / "minigrid", sandbox=sandbox) as suites:
        suites.env.reset(seed=0)
        suites.env.step(suites.env.action_space.sample())
        assert suites.provenance["interpreter"]["executable"] == "/opt/environment/bin/python"
    plain = DockerSandbox(image=IMAGE, engine=engine.kind)
    with pytest.raises(DependencyError, match="minigrid"):
        make_env(SAMPLES / "minigrid", sandbox=plain, dependencies="host")


def test_every_package_is_pinned_and_the_image_bears_the_lock(
    derived: dict[str, Any], engine: Engine
) -> None:
    """By version and by hash; the same again is not built again."""
    assert all("==" in package for package in derived["packages"])
    assert {"minigrid", "gymnasium", "numpy"} <= {
        package.partition("==")[0] for package in derived["packages"]
    }
    labels = inspected(engine, derived["image"])["Config"]["Labels"]
    assert labels["dev.envhub.lock"] == derived["lock"]
    again = built(engine, SAMPLES / "minigrid")
    assert again == {**derived, "built": False}


def test_nothing_runs_as_a_derived_interpreter_starts(
    derived: dict[str, Any], engine: Engine
) -> None:
    named = ("-name", "*.pth", "-o", "-name", "sitecustomize*", "-o", "-name", "usercustomize*")
    words = ("--entrypoint", "find", derived["image"], "/opt/environment/lib", *named)
    assert engine.run("run", "--rm", *words).strip() == ""
