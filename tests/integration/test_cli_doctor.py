"""``envhub doctor`` says what this host can enforce, and its exit code decides."""

from __future__ import annotations

import json
from typing import Any

import pytest
from typer.testing import CliRunner

from envhub_sandbox import api
from envhub_sandbox.cli.app import app
from envhub_sandbox.errors import SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.policy import PROFILES

RUNNER = CliRunner()


def test_the_strict_profile_is_tried_for_real() -> None:
    """On a host that runs these tests it holds, layer by layer."""
    done = RUNNER.invoke(app, ["doctor", "--json"])
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    profiles = {one["profile"]: one for one in found["profiles"]}
    assert tuple(profiles) == PROFILES
    strict = profiles["strict"]
    assert strict["available"]
    assert strict["first_step_s"] > 0
    assert {"seccomp", "landlock", "pid-namespace"} <= {one["layer"] for one in strict["layers"]}
    assert all(layer["enforced"] for layer in strict["layers"])


def fail_with(monkeypatch: pytest.MonkeyPatch, errors: dict[str, Exception]) -> None:
    """Have ``make_env`` fail for some profiles, and the others not be tried."""

    def make_env(folder: str, *, policy: dict[str, Any]) -> Any:
        raise errors.get(policy["profile"], SandboxUnavailableError("not this either"))

    monkeypatch.setattr(api, "make_env", make_env)


def test_what_is_missing_comes_with_its_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the words of the layer, escaped, with the exit code for it."""
    text = "this host cannot enforce user-namespace: \x1b[2J\nsysctl -w x=1"
    fail_with(monkeypatch, {"strict": SandboxUnavailableError(text)})
    done = RUNNER.invoke(app, ["doctor"])
    assert done.exit_code == 6
    assert "strict: not available here" in done.stdout
    assert "  this host cannot enforce user-namespace: \\x1b[2J\n  sysctl -w x=1\n" in done.stdout


def test_the_chosen_profile_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the others came to."""
    fail_with(monkeypatch, {"container": WorkerStartupError("it did not come up")})
    assert RUNNER.invoke(app, ["doctor", "--profile", "container"]).exit_code == 5
    assert RUNNER.invoke(app, ["doctor", "--profile", "no-userns"]).exit_code == 6


def test_an_unknown_profile_is_usage() -> None:
    """Before anything is tried."""
    done = RUNNER.invoke(app, ["doctor", "--profile", "lax"])
    assert (done.exit_code, done.stdout) == (2, "")
    assert "strict, no-userns, container" in done.stderr
