"""What cannot be had is refused, with the command that helps; nothing is quietly weaker."""

from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import PolicyError, SandboxUnavailableError
from envhub_sandbox.extras.docker import container as docker_module
from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.extras.docker.sandbox import DockerSandbox
from tests.containers.kit import IMAGE, folders, nothing_left
from tests.support.samples import sample
from tests.support.started import started


def test_a_missing_image_says_how_to_build_it(engine: Engine) -> None:
    with pytest.raises(SandboxUnavailableError, match="build -t no-such-image"):
        make_env(sample("counter"), sandbox=DockerSandbox(image="no-such-image"))


def test_a_missing_runtime_says_what_to_install(engine: Engine) -> None:
    """The engine's complaint becomes advice, and nothing is left of the attempt."""
    sandbox = DockerSandbox(image=IMAGE, engine=engine.kind, runtime="no-such-runtime")
    with pytest.raises(SandboxUnavailableError, match="runtime"):
        make_env(sample("echo"), sandbox=sandbox, env_kwargs={"nobody_asked_before": 1})
    assert nothing_left(engine)
    assert folders() == []


def test_an_interpreter_of_this_machine_makes_no_sense(docker: DockerSandbox) -> None:
    with pytest.raises(PolicyError, match="image"):
        make_env(sample("counter"), sandbox=docker, python="/usr/bin/python3")


def test_an_image_of_something_else_is_no_worker(
    engine: Engine, docker: DockerSandbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = docker_module.run_arguments.run_arguments

    def other(engine: Engine, wanted: docker_module.Container) -> list[str]:
        arguments = real(engine, wanted)
        return [*arguments[: arguments.index(wanted.image) + 1], "health"]

    monkeypatch.setattr(docker_module.run_arguments, "run_arguments", other)
    with pytest.raises(Exception, match="ended at once"):
        make_env(sample("counter"), sandbox=docker).env.reset()
    assert nothing_left(engine)


@pytest.mark.parametrize(
    ("flag", "layer"),
    [
        ("--read-only", "files"),
        ("no-new-privileges", "privileges"),
        ("--cap-drop", "capabilities"),
        ("--network", "network"),
        ("--memory", "memory"),
        ("--pids-limit", "pids"),
        ("--cpus", "cpus"),
    ],
)
def test_a_wall_that_is_missing_is_noticed(
    docker: DockerSandbox, engine: Engine, monkeypatch: pytest.MonkeyPatch, flag: str, layer: str
) -> None:
    """An engine that ignores a flag, as some do with a warning, gets no repository to run."""
    real = docker_module.run_arguments.run_arguments

    def without(engine: Engine, wanted: docker_module.Container) -> list[str]:
        words = real(engine, wanted)
        at = words.index(flag)
        if flag == "--read-only":
            return words[:at] + words[at + 1 :]
        if flag == "no-new-privileges":
            return words[: at - 1] + words[at + 1 :]
        dropped = words[:at] + words[at + 2 :]
        if flag == "--memory":
            dropped = [*dropped[:at], *dropped[at + 2 :]]  # --memory-swap means nothing alone
        return dropped

    monkeypatch.setattr(docker_module.run_arguments, "run_arguments", without)
    with pytest.raises(SandboxUnavailableError, match=f"container-{layer} does not hold"):
        make_env(sample("counter"), sandbox=docker).env.reset()
    assert nothing_left(engine)


def test_a_granted_path_is_there_and_no_other(docker: DockerSandbox, open_ground: Path) -> None:
    (open_ground / "given").write_text("of the caller's")
    policy = {"readable": [str(open_ground)]}
    with started(sample("counter"), sandbox=docker, policy=policy, seed=0):
        pass
    with pytest.raises(PolicyError, match="/usr"):
        make_env(sample("counter"), sandbox=docker, policy={"readable": ["/usr"]})
