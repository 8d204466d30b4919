"""Looking at containers from outside."""

import contextlib
import json
import os
import re
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.extras.docker.run_arguments import CLIENT_LABEL, SNAPSHOT
from envhub_sandbox.extras.docker.sandbox import DockerSandbox
from envhub_sandbox.sandboxes.pool import stop_idle
from tests.attacks.harness import Arena, Run, answered, new_alias
from tests.support.processes import eventually

_PYTHON = "/opt/envhub-worker/bin/python"
IMAGE = os.environ.get("ENVHUB_TEST_IMAGE", "envhub-worker")


def container_of(env: Any) -> str:
    [detail] = [layer["detail"] for layer in env.sandbox.report() if layer["layer"] == "container"]
    found = re.search(r"envhub-[0-9a-f]{12}", detail)
    return found[0]


def containers_of(engine: Engine, client: int) -> list[str]:
    label = f"label={CLIENT_LABEL}={client}"
    return engine.run("ps", "--all", "--quiet", "--filter", label).split()


def folders(client: int | None = None) -> list[Path]:
    """The runtime folders of a client's containers, ours by default."""
    wanted, found = str(client or os.getpid()), []
    for path in Path(tempfile.gettempdir()).glob("envhub-docker-*"):
        with contextlib.suppress(OSError):
            if (path / "alive").read_text().split()[1:2] == [wanted]:  # empty: just being written
                found.append(path)
    return found


def nothing_left(engine: Engine, client: int | None = None) -> bool:
    """Whether no container of a client is left, ours by default; waits for it.
    Of ours one may linger until its time comes; that is ended first."""
    if client is None:
        stop_idle()
    return eventually(lambda: not containers_of(engine, client or os.getpid()), 60.0)


def pids_in(engine: Engine, container: str) -> list[int]:
    """The processes of a container, as this machine numbers them."""
    if engine.kind == "podman":
        lines = engine.run("top", container, "hpid").splitlines()[1:]
        return [int(line) for line in lines]
    rows = engine.run("top", container, "-o", "pid").splitlines()[1:]
    return [int(row.split()[0]) for row in rows]


class Walls(Arena):
    """Attacks in a container: inside of a jail in it, or next to the server, without any jail.
    The second kind shows what the container's own walls hold, should a jail be broken."""

    def __init__(self, place: str, engine: Engine) -> None:
        super().__init__(place, "Containers")
        self.engine = engine
        self.options: dict[str, Any] = {}

    @contextlib.contextmanager
    def inside(
        self,
        payload: str,
        arguments: Mapping[str, Any],
        policy: Mapping[str, Any] | None = None,
        limits: Mapping[str, Any] | None = None,
    ) -> Iterator[Run]:
        """Run a payload in the place; its container lives as long as the context."""
        if self.profile != "walls":
            with super().inside(payload, arguments, policy, limits) as run:
                yield run
            return
        run = Run(new_alias(), True)
        with self.environment(policy, limits) as env:
            env.reset()
            container, harmless = container_of(env), Run(new_alias(), True)
            with self._executed(container, "where_am_i", {}, harmless):
                # so that no attack fails only because nothing can be run in there
                assert not harmless.error, harmless.text
                assert harmless.value["root"] == SNAPSHOT
            with self._executed(container, payload, arguments, run):
                yield run

    @contextlib.contextmanager
    def _executed(
        self, container: str, payload: str, arguments: Mapping[str, Any], run: Run
    ) -> Iterator[None]:
        """The control's own runner, next to the server."""
        words = [f"{SNAPSHOT}/outside.py", payload, json.dumps(dict(arguments)), run.alias]
        process = subprocess.Popen(
            [self.engine.command, "exec", "--interactive", container, _PYTHON, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        with answered(process, run):
            yield

    def place(self, policy: Mapping[str, Any]) -> dict[str, Any]:
        profile = "container" if self.profile == "bare-jail" else "strict"
        sandbox = DockerSandbox(image=IMAGE, engine=self.engine.kind, **self.options)
        return {"policy": {"profile": profile, **policy}, "sandbox": sandbox}
