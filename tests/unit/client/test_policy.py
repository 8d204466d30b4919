"""Policies, limits and timeouts: what is unknown or impossible is refused."""

import dataclasses
import re
from collections import UserList
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import Limits, Policy, Timeouts
from envhub_sandbox.errors import PolicyError
from envhub_sandbox.settings.policy import limits_from, policy_from, timeouts_from


@pytest.mark.parametrize("cls", [Policy, Limits, Timeouts])
def test_values_are_frozen_and_by_name_only(cls: type) -> None:
    made = cls()
    name = dataclasses.fields(cls)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(made, name, None)
    with pytest.raises(TypeError):
        cls(1)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (
            lambda: policy_from({"netwrok": "host"}, None),
            r"netwrok \(did you mean 'network'\?\); it has",
        ),
        (lambda: limits_from({"memory": 1}), r"no field memory \(did you mean 'memory_bytes'\?\)"),
        (lambda: timeouts_from({"step": 1}), r"step \(did you mean 'step_s'\?\); it has startup_s"),
        (lambda: policy_from({"limits": {"memory": 1}}, None), "limits has no field memory"),
        (lambda: policy_from({1: 2}, None), "policy has no field 1"),
    ],
)
def test_unknown_names_are_refused(make: Any, complaint: str) -> None:
    with pytest.raises(PolicyError, match=complaint):
        make()


def _is(name: str, value: object, takes: str = "") -> Any:
    return lambda: Policy(**{name: value}), f"{name} is {re.escape(repr(value))}{takes}"


def _limit(name: str, value: object, takes: str = "") -> Any:
    said = f"{name} is {re.escape(repr(value))}{takes}"
    return lambda: Policy(limits=Limits(**{name: value})), said


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        _is("profile", "lax", "; it is one of strict, no-userns"),
        _is("network", "all", "; it is one of none, loopback, host"),
        *(_is("restart", value) for value in ("always", "sometimes")),
        *(_is("gpu", value, "; it takes True, False or") for value in ("no", [], 1)),
        *((lambda: Policy(gpu=[True]), "gpu is"), (lambda: Policy(gpu=[-1]), "gpu is")),
        _is("readable", "/data", "; it takes a list"),
        *(_is("environment", value, "; it takes a list of strings") for value in ("HOME", b"HOME")),
        (lambda: Policy(environment=(1,)), "environment is"),
        (lambda: Policy(limits=5), "limits takes a Limits, not int"),
        (lambda: Policy(readable=("data",)), "'data'; it takes absolute paths"),
        *(_is("output", value) for value in ("", 5, None)),
        *(_is("crash_history", value) for value in (-1, 1.5, True)),
        *(_is("prewarm", value) for value in (-1, "one")),
        *(_is("crash_folder", value) for value in (b"crashes", "")),
        *(_limit("memory_bytes", value) for value in (0, None, float("inf"), float("nan"))),
        *(_limit("processes", value) for value in (-1, "4K")),
        *(_limit("open_files", value) for value in (True, 1.5)),
        _limit("disk_bytes", "1X", "; it takes a size"),
        *(
            _limit(name, least - 1, f"; it takes a whole number, {least} or more")
            for name, least in {
                "message_bytes": 1 << 20,
                "disk_files": 100,
                "open_files": 32,
            }.items()
        ),
        (lambda: Timeouts(step_s=0), "step_s is 0; it takes seconds above 0, or None"),
        (lambda: Timeouts(step_s=-1.0), "step_s is -1.0"),
        (lambda: Timeouts(step_s=True), "step_s is True"),
        (lambda: Timeouts(step_s="1"), "step_s is '1'"),
        (lambda: Timeouts(step_s=float("nan")), "step_s is nan"),
        (lambda: Timeouts(server_idle_s=-1), "server_idle_s is -1"),
        (lambda: policy_from("strict", None), "policy is 'strict'; it takes a Policy, or a map"),
        (lambda: timeouts_from(30), "timeouts is 30; it takes a Timeouts, or a mapping"),
        (
            lambda: policy_from({"limits": {"processes": 5}}, Limits(processes=7)),
            "give one of them",  # an object says all of them: none can be meant to be dropped
        ),
    ],
)
def test_impossible_values_are_refused(make: Any, complaint: str) -> None:
    with pytest.raises(PolicyError, match=complaint) as caught:
        make()
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    ("made", "meant"),
    [
        *((Timeouts(step_s=value).step_s, value) for value in (None, 0.001, 5, 1e9, float("inf"))),
        *((Timeouts(server_idle_s=value).server_idle_s, value) for value in (None, 0)),
        *((getattr(Limits(**{name: None}), name), None) for name in ("cpu_time_s", "file_bytes")),
        *(
            (Policy(limits=Limits(memory_bytes=value)).limits.memory_bytes, 4_000_000_000)
            for value in (4e9, np.int64(4_000_000_000), np.float32(4e9))
        ),
        (Policy(readable=["/data"]), Policy(readable=("/data",))),
        (Policy(output=Path("a/b.log")).output, "a/b.log"),
        (Policy(crash_folder=Path("c")).crash_folder, "c"),
        (policy_from({"limits": {"memory_bytes": "4G"}}, None).limits.memory_bytes, 4 << 30),
        (policy_from(None, {"disk_bytes": "512 MiB"}).limits.disk_bytes, 512 << 20),
        (
            policy_from({"gpu": True, "limits": {"processes": 9}}, None),
            Policy(gpu=True, limits=Limits(processes=9)),
        ),
        (policy_from({"limits": {"processes": 5}}, Limits(processes=5)).limits.processes, 5),
        (limits_from(None), None),
        (timeouts_from({"close_s": 1}), Timeouts(close_s=1)),
        (policy_from(None, None), Policy()),
        # the default needs every layer and grants nothing
        ((Policy().profile, Policy().network, Policy().gpu), ("strict", "none", False)),
        ((Policy().readable, Policy().environment, Policy().restart), ((), (), "never")),
    ],
)
def test_what_is_given_means(made: object, meant: object) -> None:
    assert (made, type(made)) == (meant, type(meant))


def test_limits_argument_changes_what_it_names() -> None:
    given = {"network": "host", "limits": {"processes": 5, "output_bytes": 9}}
    policy = policy_from(given, {"processes": 7})
    assert policy == Policy(network="host", limits=Limits(processes=7, output_bytes=9))
    assert policy_from({"gpu": True}, Limits(processes=7)).limits == Limits(processes=7)


def test_only_named_variables_get_a_value(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRANTED", "yes")
    monkeypatch.setenv("SECRET", "no")
    monkeypatch.delenv("UNSET", raising=False)
    monkeypatch.delenv("PYTHONHASHSEED", raising=False)
    granted = Policy(environment=("GRANTED", "UNSET")).confinement().environment
    assert granted == {"GRANTED": "yes"}


def test_confinement_says_what_the_policy_says() -> None:
    limits = Limits(processes=3)
    policy = Policy(
        profile="no-userns", network="loopback", readable=("/data",), gpu=True, limits=limits
    )
    made = policy.confinement()
    assert (made.profile, made.network, made.readable) == ("no-userns", "loopback", ("/data",))
    assert (made.gpu, made.limits) == (True, limits)


def test_lists_of_any_class_are_lists() -> None:
    """A configuration of Hydra's has ``ListConfig``, which is a sequence and no list."""
    names = {"environment": ["HF_HOME"], "readable": ["/srv"], "gpu": [1]}
    made = policy_from({name: UserList(given) for name, given in names.items()}, None)
    assert (made.environment, made.readable, made.gpu) == (("HF_HOME",), ("/srv",), (1,))
