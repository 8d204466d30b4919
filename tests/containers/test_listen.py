"""``docker run envhub-worker``: a server for clients outside, over TCP with keys."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from envhub_sandbox import RemoteSandbox, make_env
from envhub_sandbox.errors import WorkerDiedError
from envhub_sandbox.extras.docker.engines import Engine
from tests.compliance.pair import Pair
from tests.containers.kit import IMAGE
from tests.support.processes import eventually
from tests.support.samples import SAMPLES, reference, sample

_LOCKED = ("--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL")
_LOCKED += ("--security-opt", "no-new-privileges")
_PROFILE = SAMPLES.parent.parent / "examples" / "deployment" / "seccomp.json"
_NAMESPACES = ("--security-opt", f"seccomp={_PROFILE}", "--security-opt", "systempaths=unconfined")


@contextmanager
def served(engine: Engine, *options: str) -> Iterator[dict[str, Any]]:
    """A container that listens; what its printed line passes to ``make_env``."""
    words = ("run", "--rm", "--detach", "--publish", "127.0.0.1::5555", *options, IMAGE)
    container = engine.run(*words).strip()
    try:
        assert eventually(lambda: "ENVHUB_CLIENT_KEY" in engine.run("logs", container))
        line = re.search(r"^  sandbox=envhub_sandbox\.(.*)$", engine.run("logs", container), re.M)
        port = engine.run("port", container, "5555").split()[0].rpartition(":")[2]
        printed = line[1].replace("tcp://127.0.0.1:5555", f"tcp://127.0.0.1:{port}")
        yield eval(f"dict(sandbox={printed})", {"RemoteSandbox": RemoteSandbox})
    finally:
        engine.run("rm", "--force", container)


@pytest.mark.parametrize("options", [(), _LOCKED, (*_LOCKED, *_NAMESPACES)])
def test_the_printed_line_drives_an_environment(engine: Engine, options: tuple[str, ...]) -> None:
    """As it was printed, with a profile that can be had there; the same steps as here."""
    with (
        served(engine, *options) as arguments,
        make_env(sample("counter"), n_envs=3, **arguments) as suites,
    ):
        pair = Pair(reference("counter", 3), suites.env)
        pair.drive(seed=1, steps=40)
        layers = {layer["layer"] for layer in suites.env.sandbox.report() if layer["enforced"]}
        assert {"landlock", "seccomp"} <= layers
        assert ("user-namespace" in layers) is ("policy" not in arguments)


def test_a_killed_container_is_said_to_be_so(engine: Engine) -> None:
    """Its jails end with it; the client hears of it at its next step."""
    with served(engine) as arguments:
        suites = make_env(sample("cartpole"), **arguments)
        suites.env.reset(seed=1)
    with suites, pytest.raises(WorkerDiedError, match="connection"):
        suites.env.step(suites.env.action_space.sample())
