"""``envhub doctor`` says what this host can enforce, and its exit code decides."""

import os
from typing import Any

import pytest

from envhub_sandbox import __version__
from envhub_sandbox.cli import doctor as doctor_command
from envhub_sandbox.errors import SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.settings.policy import PROFILES
from envhub_worker.lockdown.gpus import gpu_devices
from envhub_worker.lockdown.root_plan import real_host
from tests.support.command_line import document, envhub

pytestmark = pytest.mark.short


def test_the_strict_profile_is_tried_for_real() -> None:
    """On a host that runs these tests it holds, layer by layer."""
    found = document("doctor")
    profiles = {one["profile"]: one for one in found["profiles"]}
    assert tuple(profiles) == PROFILES
    strict = profiles["strict"]
    assert (strict["available"], strict["first_step_s"] > 0) == (True, True)
    assert {"seccomp", "landlock", "pid-namespace"} <= {one["layer"] for one in strict["layers"]}
    # what a plain user runs is counted together with the rest that he runs
    counted = set() if os.getuid() == 0 else {"user-quotas"}
    assert {layer["layer"] for layer in strict["layers"] if not layer["enforced"]} == counted
    # each layer by itself, so that all that are missing can be named: a jail stops at the first
    layers = {layer["layer"]: layer for layer in found["layers"]}
    assert {"user-namespace", "mount-namespace", "landlock", "seccomp"} <= set(layers)
    assert layers["seccomp"]["available"]
    assert found["gpu"] == list(gpu_devices(real_host()))


def test_what_else_explains_a_host_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Versions, the container engine or why there is none, free memory and disk."""
    fail_with(monkeypatch, {})
    monkeypatch.setenv("PATH", "/nowhere")
    found = document("doctor", code=6)
    assert found["versions"]["envhub-sandbox"] == __version__
    assert found["engine"]["kind"] is None
    assert "no docker on PATH" in found["engine"]["problem"]
    assert found["versions"]["numpy"]
    assert min(found["free_memory_bytes"], found["disk"]["free_bytes"]) > 0


def test_all_missing_layers_are_named_with_their_fixes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two are missing: both are told, and the profile for AppArmor is printed as it is."""
    layers = [
        {"layer": "user-namespace", "available": False, "detail": "denied", "fix": "sysctl -w x=1"},
        {"layer": "landlock", "available": False, "detail": "none\x1b[2J", "fix": "Linux 5.13"},
        {"layer": "seccomp", "available": True, "detail": "", "fix": ""},
    ]
    profile = "profile x [/usr/bin/python3] { userns, }"
    probed = {"layers": layers, "apparmor_profile": profile, "gpu": ["/dev/dri/\x1b[2J"]}
    monkeypatch.setattr(doctor_command, "probe", lambda: probed)
    fail_with(monkeypatch, {})
    printed = envhub("doctor").stdout
    for text in (
        *("  user-namespace: denied\n    sysctl -w x=1\n", profile),
        *("  landlock: none\\x1b[2J\n    Linux 5.13\n", "GPU: /dev/dri/\\x1b[2J\n"),
    ):
        assert text in printed
    assert "  seccomp" not in printed


def fail_with(monkeypatch: pytest.MonkeyPatch, errors: dict[str, Exception]) -> None:
    def make_env(folder: str, *, policy: dict[str, Any], sandbox: str) -> Any:
        raise errors.get(policy["profile"], SandboxUnavailableError("not this either"))

    monkeypatch.setattr("envhub_sandbox.factory.make_env.make_env", make_env)


def test_what_is_missing_comes_with_its_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the words of the layer, escaped, with the exit code of the chosen profile."""
    text = "this host cannot enforce user-namespace: \x1b[2J\nsysctl -w x=1"
    fail_with(monkeypatch, {"strict": SandboxUnavailableError(text)})
    told = envhub("doctor", code=6).stdout
    assert "strict: not available here" in told
    assert "  this host cannot enforce user-namespace: \\x1b[2J\n  sysctl -w x=1\n" in told
    assert "no-userns, container: not available here\n  not this either\n" in told
    assert told.count("not this either") == 1, "those with the same reason share it"
    fail_with(monkeypatch, {"container": WorkerStartupError("it did not come up")})
    for profile, code in (("container", 5), ("no-userns", 6)):
        envhub("doctor", "--profile", profile, code=code)


def test_a_cache_that_cannot_be_used_hides_no_layer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The layers are tried with a cache of its own, and what is wrong with the caller's is said."""
    monkeypatch.setenv("ENVHUB_CACHE", "/dev/null/none")
    told = envhub("doctor", code=3).stdout
    assert "strict: available" in told
    assert "The cache: /dev/null/none cannot be written: set ENVHUB_CACHE to another" in told
    assert os.environ["ENVHUB_CACHE"] == "/dev/null/none"


def test_a_user_without_a_home_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object, **__: object) -> str:
        raise RuntimeError("could not determine the home directory")

    fail_with(monkeypatch, {})
    monkeypatch.delenv("ENVHUB_CACHE", raising=False)
    monkeypatch.setattr("platformdirs.user_cache_dir", none)
    assert "set ENVHUB_CACHE to a folder" in envhub("doctor").stdout
    disk = document("doctor", code=6)["disk"]
    assert disk["folder"] is None
    assert "no home" in disk["problem"]


@pytest.mark.parametrize(("command", "code"), [("doctor", 6), ("cache gc --dry-run", 0)])
def test_nothing_can_be_written(command: str, code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a read-only container there is no place for temporary files, and nothing is left there."""

    def none() -> str:
        raise FileNotFoundError(2, "No usable temporary directory found")

    monkeypatch.setattr("tempfile.gettempdir", none)
    monkeypatch.setenv("PATH", "/nowhere")
    told = envhub(*command.split(), code=code).stderr
    assert ("bug" in told, "--tmpfs /tmp" in told) == (False, command == "doctor")


def test_only_the_profile_that_was_asked_for_is_printed_layer_by_layer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All have a row in the table of profiles, with the layers that are missing."""
    layers = [
        {"layer": "seccomp", "enforced": True, "detail": "a list"},
        {"layer": "pid-namespace", "enforced": False, "detail": "none"},
    ]
    tried = {"available": True, "layers": layers, "first_step_s": 0.1}
    trial = doctor_command.Trial
    monkeypatch.setattr(doctor_command, "examine", lambda _, name: trial(name, **tried))
    probed = {"layers": [], "apparmor_profile": None, "gpu": None}
    monkeypatch.setattr(doctor_command, "probe", lambda: probed)
    printed = envhub("doctor", "--profile", "container").stdout
    profiles = [line.split()[0] for line in printed.splitlines() if "1 of 2 layers" in line]
    assert profiles == ["container", "strict", "no-userns"]
    assert printed.count("1 of 2 layers  pid-namespace\n") == 3
    assert printed.count("seccomp        holds    a list\n") == 1
