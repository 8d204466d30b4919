"""From a policy to an engine's command line, and from what a container says to what holds."""

import itertools
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import PolicyError, SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.extras.docker import attestation, engines, run_arguments
from envhub_sandbox.extras.docker.container import ContainerServer
from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.extras.docker.run_arguments import Container
from envhub_sandbox.extras.docker.sandbox import DockerSandbox
from envhub_sandbox.settings.policy import Limits, Policy
from envhub_worker.lockdown.seccomp import policy as seccomp_policy
from envhub_worker.protocol.confinement import Surroundings
from envhub_worker.protocol.runtime import Runtime
from tests.unit.docs.test_imports import folder

DOCKER = Engine("docker", "/usr/bin/docker", "28", rootless=False)
PODMAN = Engine("podman", "/usr/bin/podman", "5", rootless=True)
WANTED = Container(
    name="envhub-0",
    image="sha256:1",
    labels={"dev.envhub.client": "1:2:3:4"},
    sockets="/tmp/f/sockets",
    snapshot="/store/tree",
    readable=("/data",),
    seccomp="/tmp/f/seccomp.json",
    user=(1000, 1000),
    network="none",
    memory=1 << 30,
    pids=99,
    cpus=1.5,
    scratch=1 << 20,
    runtime=None,
    gpus=None,
)
SAID: dict[str, Any] = {
    "envhub-worker": "0.1.0",
    "profiles": ["strict", "no-userns", "container"],
    "landlock": 7,
    "user": 1000,
    "capabilities": 0,
    "no_new_privileges": True,
    "seccomp": True,
    "read_only": True,
    "devices": ["lo"],
    "memory": 1 << 30,
    "pids": 99,
    "cpus": 1.5,
    "python": "",
}


def found(**changes: Any) -> Surroundings:
    return attestation.parse(json.dumps({**SAID, **changes}).encode())


def test_the_command_line_is_this_one() -> None:
    assert run_arguments.run_arguments(DOCKER, WANTED) == [
        *("run", "--rm", "--interactive", "--pull", "never", "--log-driver", "none"),
        *("--no-healthcheck", "--name", "envhub-0", "--hostname", "sandbox", "--workdir", "/"),
        *("--label", "dev.envhub.client=1:2:3:4"),
        *("--network", "none", "--read-only", "--cap-drop", "ALL"),
        *("--security-opt", "no-new-privileges", "--security-opt", "seccomp=/tmp/f/seccomp.json"),
        *("--security-opt", "systempaths=unconfined", "--ipc", "private", "--user", "1000:1000"),
        *("--ulimit", "core=0:0", "--memory", "1073741824", "--memory-swap", "1073741824"),
        *("--pids-limit", "99", "--cpus", "1.5"),
        *("--tmpfs", "/tmp:rw,nosuid,nodev,size=1048576,mode=1777", "--shm-size", "1073741824"),
        *("--mount", '"type=bind","src=/tmp/f/sockets","dst=/run/envhub"'),
        *("--mount", '"type=bind","src=/store/tree","dst=/snapshots/this","readonly"'),
        *("--mount", '"type=bind","src=/data","dst=/data","readonly"'),
        "sha256:1",
        *("serve", "--endpoint", "ipc:///run/envhub/server", "--fd-path", "/run/envhub/fds"),
        *("--runtime-dir", "/tmp/envhub-worker", "--readable-root", "/snapshots"),
        *("--until-eof", "--announce"),
    ]


WITH_GPUS = {"runtime": "runsc", "gpus": "all"}
NO_GROUPS = {"memory": None, "pids": None, "cpus": None}


@pytest.mark.parametrize(
    ("engine", "changes", "expected"),
    [
        (
            PODMAN,  # the same walls; a plain user keeps the id, and no writable folder is added
            {},
            {("--userns", "keep-id"), ("--security-opt", "unmask=ALL"), "--read-only-tmpfs=false"},
        ),
        (replace(DOCKER, remapped=True), {}, {("--userns", "host")}),  # the sockets are ours
        (DOCKER, WITH_GPUS, {("--runtime", "runsc"), ("--gpus", "all")}),
        (PODMAN, WITH_GPUS, {("--runtime", "runsc"), ("--device", "nvidia.com/gpu=all")}),
        (PODMAN, NO_GROUPS, {"--cgroups=disabled"}),
        (
            DOCKER,  # a comma in a path adds no option to a mount
            {"snapshot": '/store/a,dst=/etc,"b"'},
            {'"type=bind","src=/store/a,dst=/etc,""b""","dst=/snapshots/this","readonly"'},
        ),
    ],
    ids=["podman", "users mapped", "docker's GPUs", "podman's GPUs", "no groups", "a comma"],
)
def test_words_of_each_engine(engine: Engine, changes: dict[str, Any], expected: set[Any]) -> None:
    words = run_arguments.run_arguments(engine, replace(WANTED, **changes))
    assert expected <= {*words, *itertools.pairwise(words)}
    assert ("--memory" in words) == ("--pids-limit" in words) == (changes is not NO_GROUPS)


def test_assets_are_mounted_beside_the_snapshot_and_read_only() -> None:
    words = run_arguments.run_arguments(DOCKER, replace(WANTED, assets=("/c/a/tree", "/c/b/tree")))
    for number, path in enumerate(("/c/a/tree", "/c/b/tree")):
        place = f'"dst=/snapshots/asset-{number}"'
        assert f'"type=bind","src={path}",{place},"readonly"' in words


def test_limits_leave_room_for_the_server() -> None:
    policy = Policy(limits=Limits(memory_bytes=1 << 30, processes=10))
    assert run_arguments.memory_for(policy) == 2 << 30
    assert run_arguments.pids_for(policy) == 266


@pytest.mark.parametrize("path", ["/", "/usr", "/proc/", "//etc", "/data/../etc"])
def test_a_containers_own_folders_cannot_be_replaced(path: str) -> None:
    """A path that is granted would cover the interpreter, or worse."""
    with pytest.raises(PolicyError, match="readable"):
        run_arguments.check_readable((path,))


@pytest.mark.parametrize(
    ("changes", "layer"),
    [
        ({"user": 0}, "user"),
        ({"user": 1001}, "user"),
        ({"capabilities": 1}, "capabilities"),
        ({"no_new_privileges": False}, "privileges"),
        ({"read_only": False}, "files"),
        ({"devices": ["lo", "eth0"]}, "network"),
        ({"seccomp": False}, "seccomp"),
        ({"memory": None}, "memory"),
        ({"memory": 2 << 30}, "memory"),
        ({"pids": None}, "pids"),
        ({"cpus": 2.0}, "cpus"),
    ],
)
def test_a_wall_that_does_not_stand_is_refused(changes: dict[str, Any], layer: str) -> None:
    with pytest.raises(SandboxUnavailableError, match=f"container-{layer} does not hold"):
        attestation.layers(WANTED, found(**changes), "docker 28")


def test_what_the_caller_goes_without_is_in_the_report() -> None:
    wanted = replace(WANTED, network="host", runtime="runsc", memory=None, pids=None, cpus=None)
    every = attestation.layers(WANTED, found(), "docker 28")
    assert all(layer["enforced"] for layer in every)
    assert [layer["layer"] for layer in every] == [
        *("container", "container-user", "container-capabilities", "container-privileges"),
        *("container-files", "container-network", "container-seccomp", "container-memory"),
        *("container-pids", "container-cpus"),
    ]
    report = attestation.layers(wanted, found(devices=["eth0"], seccomp=False, memory=None), "x")
    absent = {layer["layer"] for layer in report if not layer["enforced"]}
    assert absent == {"container-network", "container-seccomp", "container-memory"}


@pytest.mark.parametrize(
    ("wanted", "profiles", "landlock", "chosen"),
    [
        ("strict", ["strict", "no-userns", "container"], 7, "strict"),
        ("strict", ["no-userns", "container"], 7, "container"),
        ("strict", ["container"], 1, "container"),
        ("no-userns", ["strict", "no-userns", "container"], 7, "no-userns"),
        ("container", ["container"], 0, "container"),
        ("strict", ["container"], 0, None),
        ("no-userns", ["container"], 2, None),
        ("strict", [], 7, None),
    ],
)
def test_jails_get_the_strongest_profile_that_can_be_had(
    wanted: str, profiles: list[str], landlock: int, chosen: str | None
) -> None:
    """The weaker ones by name only; one that nothing parts from the server is refused."""
    said = found(profiles=profiles, landlock=landlock)
    if chosen is not None:
        assert attestation.profile_for(wanted, said) == chosen
        return
    with pytest.raises(SandboxUnavailableError):
        attestation.profile_for(wanted, said)


@pytest.mark.parametrize(
    "line",
    [
        *(b"", b"{}", b"[]", b"hello", b'{"profiles": 3}', b"[" * 100_000),
        json.dumps({**SAID, "pids": float("inf")}).encode(),
    ],
    ids=["nothing", "no field", "a list", "a word", "a number", "too deep", "no number"],
)
def test_an_announcement_that_is_none_is_refused(line: bytes) -> None:
    with pytest.raises(WorkerStartupError, match="build it again"):
        attestation.parse(line)


def test_the_profile_permits_what_jails_may_call() -> None:
    """The container's filter lies around the jail's: it must not be the narrower one."""
    inner = {
        name
        for namespaced in (True, False)
        for network in ("none", "loopback", "host")
        for name, verdict in seccomp_policy.policy_table(
            namespaced=namespaced, network=network, brokered=not namespaced
        ).items()
        if verdict not in (seccomp_policy.EPERM, seccomp_policy.ENOSYS)
    }
    outer = {
        name
        for rule in run_arguments.seccomp_profile("x86_64")["syscalls"]
        for name in rule["names"]
    }
    assert len(inner) > 200
    assert inner <= outer


def test_the_profile_permits_what_lockdown_calls() -> None:
    tried = {"ptrace"}
    texts = [path.read_text() for path in folder("envhub_worker").rglob("*.py")]
    called = {name for text in texts for name in re.findall(r'syscall\(\s*"(\w+)"', text)}
    assert {"landlock_create_ruleset", "open_tree", "seccomp"} <= called
    assert called - tried <= run_arguments.ALLOWED


def test_the_profile_denies_what_reaches_the_kernels_innards() -> None:
    assert run_arguments.seccomp_profile("aarch64")["defaultAction"] == "SCMP_ACT_ERRNO"
    denied = """
        acct add_key bpf delete_module fanotify_init finit_module init_module io_uring_enter
        io_uring_setup ioperm iopl kcmp kexec_file_load kexec_load keyctl lookup_dcookie modify_ldt
        name_to_handle_at open_by_handle_at perf_event_open pidfd_getfd process_madvise
        process_vm_readv process_vm_writev ptrace quotactl reboot request_key setdomainname swapoff
        swapon syslog userfaultfd vhangup
    """
    assert not set(denied.split()) & run_arguments.ALLOWED


def test_the_profile_for_ones_own_containers_is_the_same() -> None:
    """The file that the documents name, for either machine; and of 64 bits only."""
    path = Path(__file__).resolve().parents[5] / "examples" / "deployment" / "seccomp.json"
    made = run_arguments.seccomp_profile("x86_64")
    assert made["architectures"] == ["SCMP_ARCH_X86_64"]
    architectures = sorted(run_arguments.ARCHITECTURES.values())
    assert json.loads(path.read_text()) == {**made, "architectures": architectures}
    with pytest.raises(SandboxUnavailableError, match="riscv64"):
        run_arguments.seccomp_profile("riscv64")


@pytest.mark.parametrize(
    "image", ["", "-it", "--format=x", "a b", "a\nRUN evil", "a\t", "a\u2028b", " envhub-worker"]
)
def test_what_names_no_image_reaches_no_engine(image: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would be an option, or a line of a recipe; a name is asked for as it stands."""
    asked = list[str]()
    monkeypatch.setattr(Engine, "run", lambda _, *words: asked.extend(words) or "sha256:1\n")
    with pytest.raises(PolicyError, match="not the name of an image"):
        engines.find_image(DOCKER, image)
    assert asked == []
    assert engines.find_image(DOCKER, "reg.example:5000/a/b_c@sha256:0") == "sha256:1"
    assert asked[-1] == "reg.example:5000/a/b_c@sha256:0"


@pytest.mark.parametrize(
    ("said", "advice"),
    [
        ("permission denied while trying to connect to the Docker daemon socket", "usermod"),
        ("Cannot connect to the Docker daemon at unix:///x", "systemctl start docker"),
        ("docker: Error response from daemon: Unknown runtime specified x.", "it failed"),
        ("unknown or invalid runtime name: runsc", "runsc install"),
        ('could not select device driver "" with capabilities: [[gpu]]', "nvidia-ctk"),
        ("", "without a word"),
    ],
)
def test_an_engines_complaint_becomes_advice(said: str, advice: str) -> None:
    assert advice in engines.explained("docker", said)


def test_nobody_is_advised_to_do_what_he_has_done() -> None:
    """An engine that fails over control groups all the same, without any limit."""
    said = "Error: OCI runtime error: writing file cgroup.procs: permission denied"
    assert "cgroups=False" in engines.explained("podman", said)
    advice = engines.explained("podman", said, limited=False)
    assert "cgroups=False" not in advice
    assert "containers.conf" in advice


def test_without_an_engine_each_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SandboxUnavailableError, match=r"docker\.io.*podman"):
        engines.find_engine(None)


def test_a_remote_engine_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "docker"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("DOCKER_HOST", "tcp://far.example:2376")
    with pytest.raises(SandboxUnavailableError, match=r"tcp://far\.example"):
        engines.find_engine("docker")


def engine_that_says(
    folder: Path, monkeypatch: pytest.MonkeyPatch, version: str, facts: dict[str, Any]
) -> Engine:
    program = folder / "docker"
    answers = f"echo '{version}' || echo '{json.dumps(facts)}'"
    program.write_text(f"#!/bin/sh\n[ $1 = --version ] && {answers}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.delenv("DOCKER_HOST", raising=False)
    return engines.find_engine("docker")


@pytest.mark.parametrize(
    ("program", "facts", "expected"),
    [
        ("Docker version 28", ["name=seccomp"], ("docker", "28.0", False, False)),
        ("Docker version 28", ["name=seccomp", "name=rootless"], ("docker", "28.0", True, False)),
        ("Docker version 28", ["name=userns"], ("docker", "28.0", False, True)),
        # some systems have podman under docker's name; it takes podman's options
        ("podman version 5.1", [], ("podman", "5.1", True, False)),
    ],
)
def test_an_engine_says_what_it_is(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    program: str,
    facts: list[str],
    expected: tuple[str, str, bool, bool],
) -> None:
    """Rootless docker is refused; one that maps users gets an option against that."""
    said = {
        "ServerVersion": "28.0",
        "SecurityOptions": facts,
        "host": {"security": {"rootless": True}},
        "version": {"Version": "5.1"},
    }
    engine = engine_that_says(tmp_path, monkeypatch, program, said)
    assert (engine.kind, engine.version, engine.rootless, engine.remapped) == expected
    if expected[0] == "docker" and expected[2]:
        with pytest.raises(SandboxUnavailableError, match="podman"):
            DockerSandbox(engine="docker").for_repository(tmp_path, Policy(), Runtime(""))


def test_engines_without_servers_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    facts = {"ServerErrors": ["Cannot connect to the Docker daemon at unix:///x"]}
    with pytest.raises(SandboxUnavailableError, match="systemctl start docker"):
        engine_that_says(tmp_path, monkeypatch, "Docker version 28", facts)


def test_secrets_do_not_go_to_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_TOKEN", "secret")
    monkeypatch.setenv("DOCKER_CONFIG", "/somewhere")
    assert "HF_TOKEN" not in engines.environment()
    assert engines.environment()["DOCKER_CONFIG"] == "/somewhere"


@pytest.mark.parametrize("options", [{"memory": 0}, {"pids": -1}, {"cpus": 0.0}])
def test_impossible_limits_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(PolicyError, match="more than 0"):
        DockerSandbox(**options)


def test_a_container_whose_monitor_was_killed_leaves_no_folder() -> None:
    """The monitor cannot remove it then; whoever gives the container up does."""
    server = ContainerServer()
    words = [sys.executable, "-S", "-c", "input()"]
    with server.starting(lambda ready: subprocess.Popen(words, stdin=subprocess.PIPE)):
        server.process.kill()
        server.process.communicate()
    assert not server.runs
    server.stop()
    assert not server.folder.exists()
