"""Container engines, docker and podman alike, through their stable command line."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import PolicyError, SandboxUnavailableError
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.platform import IS_LINUX, own_variables

if sys.platform == "linux":
    import resource

ENGINES = ("docker", "podman")
_ANSWER_S = 60.0
_KEPT = ("PATH", "HOME", "USER", "LOGNAME", "LANG", "LC_ALL", "TMPDIR", "DBUS_SESSION_BUS_ADDRESS")
_KEPT_PREFIXES = ("XDG_", "DOCKER_", "CONTAINER_", "CONTAINERS_", "REGISTRY_AUTH_")


class EngineError(Exception):
    """The engine's command failed; its text is what it wrote to stderr."""


@dataclass(frozen=True)
class Engine:
    """An engine that answers.

    Attributes:
        kind: ``"docker"`` or ``"podman"``: whose options it takes.
        rootless: Whether it runs as a plain user.
        remapped: Whether it maps the users of containers to others (``userns-remap``).
        passed_over: Why a preferred engine was not chosen.
        machine: Its architecture; on macOS and Windows that of a virtual machine.
        cpus: The number of that machine's processors; 0 for unknown.
    """

    kind: str
    command: str
    version: str
    rootless: bool
    remapped: bool = False
    passed_over: str = ""
    machine: str = ""
    cpus: int = 0

    def run(self, *arguments: str) -> str:
        """Runs a command; returns its output. Raises ``EngineError``: it failed or hung."""
        return _run(self.command, *arguments)


def environment() -> dict[str, str]:
    """Returns our environment variables that the engine needs, without a token of the Hub."""
    return own_variables() | {
        name: value
        for name, value in os.environ.items()
        if name in _KEPT or name.startswith(_KEPT_PREFIXES)
    }


def _run(command: str, *arguments: str) -> str:
    try:
        done = subprocess.run(
            [command, *arguments],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env=environment(),
            timeout=_ANSWER_S,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise EngineError(str(error)) from error
    if done.returncode != 0:
        raise EngineError(done.stderr.decode(errors="replace").strip())
    return done.stdout.decode(errors="replace")


def find_engine(name: str | None) -> Engine:
    """Returns the engine of a name; for None docker if it answers, else podman.
    Raises ``PolicyError``: there is no engine of that name; ``SandboxUnavailableError``: it is not
    installed, does not run, or may not be used.
    """
    if name is not None and name not in ENGINES:
        raise PolicyError(f"engine is {name!r}; it is one of {', '.join(ENGINES)}, or None")
    problems: list[str] = []
    for candidate in (name,) if name else ENGINES:
        # a failure is not remembered: it may be repaired meanwhile
        try:
            engine = _engine(candidate, os.environ.get("PATH"), os.environ.get("DOCKER_HOST"))
            return replace(engine, passed_over=" ".join(problems))
        except SandboxUnavailableError as error:
            problems.append(f"{candidate}: {error}")
    raise SandboxUnavailableError("no container engine can be used. " + " ".join(problems))


def is_elsewhere(name: str) -> bool:
    """Whether an engine works on another machine, which lacks our files."""
    host = os.environ.get("DOCKER_HOST")
    return name == "docker" and bool(host) and not str(host).startswith(("unix:", "npipe:"))


@lru_cache(maxsize=8)
def _engine(name: str, path: str | None, host: str | None) -> Engine:
    command = shutil.which(name, path=path)
    if command is None:
        raise SandboxUnavailableError(f"there is no {name} on PATH; {_INSTALL[name]}.")
    if is_elsewhere(name):
        raise SandboxUnavailableError(
            f"DOCKER_HOST is {host}: a container on another host shares nothing with this process. "
            "Run the worker there, and connect to it with "
            f"{option_name('sandbox', 'tcp://HOST:PORT')}."
        )
    try:
        kind = "podman" if "podman" in _run(command, "--version") else name
        return _described(kind, command)
    except EngineError as error:
        raise SandboxUnavailableError(explained(name, str(error))) from error


def _described(kind: str, command: str) -> Engine:
    try:
        facts = json.loads(_run(command, "info", "--format", "{{json .}}"))
    except ValueError as error:
        raise EngineError(f"its answer is not JSON: {error}") from error
    if kind == "podman":
        rootless = bool(_at(facts, "host", "security", "rootless"))
        return Engine(
            kind,
            command,
            str(_at(facts, "version", "Version")),
            rootless,
            machine=str(_at(facts, "host", "arch") or ""),
            cpus=_count(_at(facts, "host", "cpus")),
        )
    if not facts.get("ServerVersion"):  # podman's docker answers by failing; docker may not
        raise EngineError(" ".join(map(str, facts.get("ServerErrors") or ["it does not answer"])))
    options = " ".join(facts.get("SecurityOptions") or [])
    return Engine(
        kind,
        command,
        str(facts["ServerVersion"]),
        rootless="name=rootless" in options,
        remapped="name=userns" in options,
        machine=str(facts.get("Architecture") or ""),
        cpus=_count(facts.get("NCPU")),
    )


def _count(number: object) -> int:
    return number if type(number) is int and number > 0 else 0


def _at(facts: Mapping[str, Any], *path: str) -> Any:
    value: Any = facts
    for name in path:
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


_INSTALL = {
    "docker": "run: sudo apt-get install docker.io (or see docs.docker.com/engine/install)",
    "podman": "run: sudo apt-get install podman",
}
_START = "it does not run. Run: sudo systemctl start docker."
if not IS_LINUX:
    _INSTALL = {
        "docker": "install Docker Desktop (docs.docker.com/desktop)",
        "podman": "install it (podman.io/docs/installation), and run: podman machine init",
    }
    _START = "it does not run. Start Docker Desktop, or for podman run: podman machine start."
_EXPLAINED = (
    (
        "permission denied while trying to connect",
        "you may not use it. Run: sudo usermod -aG docker $USER, and log in again (members of that "
        "group can become root on this machine), or use podman, which needs no such right.",
    ),
    ("Cannot connect to the Docker daemon", _START),
    ("Is the docker daemon running", _START),
    ("dial unix", _START),
    ("docker_engine", _START),
    ("Cannot connect to Podman", _START),
    (
        "nknown or invalid runtime name",
        "it has no such runtime. Install it and name it in /etc/docker/daemon.json "
        "(for gVisor: sudo runsc install), then run: sudo systemctl restart docker.",
    ),
    (
        "could not select device driver",
        "it cannot give GPUs to a container. Install the NVIDIA container toolkit and run: "
        "sudo nvidia-ctk runtime configure --runtime=docker, then sudo systemctl restart docker.",
    ),
    (
        "Range of CPUs",
        "it has fewer processors than requested; see DockerSandbox(cpus=...) in Python.",
    ),
    (
        "bind source path does not exist",
        "it cannot access this machine's files (an engine in a virtual machine, or one that was "
        "installed as a snap): use DockerSandbox(published=True) in Python.",
    ),
    (
        "cgroup",
        "it cannot limit memory, processes and time here. Delegate control groups to it, or use "
        "no limits of the container: DockerSandbox(cgroups=False) in Python. Each jail still has "
        "its own limits.",
    ),
)


_WITHOUT_LIMITS = (
    "it uses control groups of its own accord and cannot here, though it was asked for no limits: "
    'tell it not to, with cgroups = "disabled" under [containers] in containers.conf, or docker.'
)


def explained(engine: str, stderr: str, *, limited: bool = True) -> str:
    """What an engine's complaint means, and the command that mends it.
    ``limited``: whether it was asked for limits; if not, the advice is not to leave them out.
    """
    for text, meaning in _EXPLAINED:
        if text in stderr:
            meaning = meaning if limited or text != "cgroup" else _WITHOUT_LIMITS
            return f"{meaning} ({engine} says: {_last_line(stderr)})"
    return f"it failed: {_last_line(stderr) or 'without a word'}"


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    telling = [line for line in lines if not line.startswith(("See '", "Run '"))] or lines
    return telling[-1][:500] if telling else ""


def own_limits(engine: Engine) -> tuple[str, ...]:
    """For ``--ulimit``: podman would raise ours to numbers of its own, which not all may."""
    if engine.kind == "podman" and sys.platform == "linux":
        _, files = resource.getrlimit(resource.RLIMIT_NOFILE)
        _, processes = resource.getrlimit(resource.RLIMIT_NPROC)
        # it has taken that much of this one from itself by then
        highest = int(Path("/proc/sys/kernel/pid_max").read_text())
        processes = highest if processes < 0 else min(processes, highest)
        return f"nofile={files}:{files}", f"nproc={processes}:{processes}"
    return ()


def find_image(engine: Engine, image: str) -> str:
    """Returns the id of an image, so that the inspected image is the one that runs.
    Raises ``PolicyError``: that is no name of an image: the engine would read it as something else;
    ``SandboxUnavailableError``: the engine does not have it.
    """
    if not image.isprintable() or not image or image.startswith("-") or " " in image:
        raise PolicyError(
            f"{image!r} is not the name of an image: it is empty, begins with '-', or has spaces"
        )
    try:
        return engine.run("image", "inspect", "--format", "{{.Id}}", image).strip()
    except EngineError as error:
        text = str(error)
        if "no such image" not in text.lower() and "not known" not in text:
            raise SandboxUnavailableError(explained(engine.kind, text)) from error
    build = f"{engine.kind} build -t {image} ."
    get = f"{engine.kind} pull {image}" if "/" in image else f"{build} (in a checkout of envhub)"
    reason = f" It was asked because of {engine.passed_over}" if engine.passed_over else ""
    raise SandboxUnavailableError(f"{engine.kind} has no image {image!r}; run: {get}.{reason}")
