"""Policies, limits and timeouts: what is unknown or impossible is refused."""

from __future__ import annotations

import dataclasses
from collections import UserList
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import Limits, Policy, Timeouts
from envhub_sandbox.errors import PolicyError
from envhub_sandbox.settings.policy import limits_from, policy_from, timeouts_from


def test_nothing_given_means_the_strictest() -> None:
    policy = policy_from(None, None)
    assert policy == Policy()
    assert (policy.profile, policy.network, policy.gpu) == ("strict", "none", False)
    assert (policy.readable, policy.environment, policy.restart) == ((), (), "never")


@pytest.mark.parametrize("cls", [Policy, Limits, Timeouts])
def test_values_are_frozen_and_by_name_only(cls: type) -> None:
    """Nobody can change a policy that is in force, or mistake one field for another."""
    made = cls()
    name = dataclasses.fields(cls)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(made, name, None)
    with pytest.raises(TypeError):
        cls(1)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: policy_from({"netwrok": "host"}, None), "policy has no field netwrok; it has"),
        (lambda: limits_from({"memory": 1}), "limits has no field memory; it has memory_bytes"),
        (lambda: timeouts_from({"step": 1}), "timeouts has no field step; it has startup_s"),
        (lambda: policy_from({"limits": {"memory": 1}}, None), "limits has no field memory"),
        (lambda: policy_from({1: 2}, None), "policy has no field 1"),
    ],
)
def test_unknown_names_are_refused(make: Any, complaint: str) -> None:
    with pytest.raises(PolicyError, match=complaint):
        make()


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: Policy(profile="lax"), "profile is 'lax'; it is one of strict, no-userns"),
        (lambda: Policy(network="all"), "network is 'all'; it is one of none, loopback, host"),
        (lambda: Policy(restart="always"), "restart is 'always'"),
        (lambda: Policy(restart="sometimes"), "restart is 'sometimes'"),
        (lambda: Policy(gpu="no"), "gpu is 'no'; it takes True, False or"),  # type: ignore[arg-type]
        (lambda: Policy(gpu=[]), r"gpu is \[\]; it takes True, False or a list"),
        (lambda: Policy(gpu=[True]), "gpu is"),
        (lambda: Policy(gpu=[-1]), "gpu is"),
        (lambda: Policy(gpu=1), "gpu is 1; it takes True, False or"),  # type: ignore[arg-type]
        (lambda: Policy(readable="/data"), "readable is '/data'; it takes a list"),  # type: ignore[arg-type]
        (lambda: Policy(environment="HOME"), "environment is 'HOME'"),  # type: ignore[arg-type]
        (lambda: Policy(environment=(1,)), "environment is"),  # type: ignore[arg-type]
        (lambda: Policy(limits=5), "limits takes a Limits, not int"),  # type: ignore[arg-type]
        (lambda: Policy(readable=("data",)), "'data'; it takes absolute paths"),
        (lambda: Policy(limits=Limits(memory_bytes=0)), "memory_bytes is 0"),
        (lambda: Policy(limits=Limits(processes=-1)), "processes is -1"),
        (lambda: Policy(limits=Limits(open_files=True)), "open_files is True"),
        (lambda: Policy(limits=Limits(open_files=1.5)), "open_files is 1.5"),  # type: ignore[arg-type]
        (lambda: Policy(limits=Limits(disk_bytes="1X")), "disk_bytes is '1X'; it takes a size"),  # type: ignore[arg-type]
        (lambda: Policy(limits=Limits(memory_bytes=None)), "memory_bytes is None"),  # type: ignore[arg-type]
        (lambda: Policy(limits=Limits(memory_bytes=float("inf"))), "memory_bytes is inf"),  # type: ignore[arg-type]
        (lambda: Policy(limits=Limits(memory_bytes=float("nan"))), "memory_bytes is nan"),  # type: ignore[arg-type]
        (lambda: Timeouts(step_s=0), "step_s is 0; it takes seconds above 0, or None"),
        (lambda: Timeouts(step_s=-1.0), "step_s is -1.0"),
        (lambda: Timeouts(step_s=True), "step_s is True"),
        (lambda: Timeouts(step_s="1"), "step_s is '1'"),  # type: ignore[arg-type]
        (lambda: Timeouts(step_s=float("nan")), "step_s is nan"),
        (lambda: policy_from("strict", None), "policy takes a Policy or a mapping, not str"),  # type: ignore[arg-type]
        (lambda: timeouts_from(30), "timeouts takes a Timeouts or a mapping, not int"),  # type: ignore[arg-type]
    ],
)
def test_impossible_values_are_refused(make: Any, complaint: str) -> None:
    with pytest.raises(PolicyError, match=complaint) as caught:
        make()
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize("value", [None, 0.001, 5, 1e9, float("inf")])
def test_timeouts_take_seconds_or_none(value: float | None) -> None:
    assert Timeouts(step_s=value).step_s == value


@pytest.mark.parametrize("name", ["cpu_time_s", "file_bytes"])
def test_some_limits_can_be_lifted(name: str) -> None:
    assert getattr(Policy(limits=Limits(**{name: None})).limits, name) is None


@pytest.mark.parametrize("value", [4e9, np.int64(4_000_000_000), np.float32(4e9)])
def test_whole_numbers_of_any_type_are_ints(value: Any) -> None:
    """``4e9`` bytes is a fine way to say it, and travels as an int."""
    made = Policy(limits=Limits(memory_bytes=value)).limits.memory_bytes
    assert (type(made), made) == (int, 4_000_000_000)


def test_lists_become_tuples() -> None:
    """A policy out of a JSON file equals one that was written in Python."""
    assert Policy(readable=["/data"]) == Policy(readable=("/data",))  # type: ignore[arg-type]


def test_limits_argument_changes_what_it_names() -> None:
    """``make_env(limits=...)`` is the last word on these, and leaves the others alone."""
    given = {"network": "host", "limits": {"processes": 5, "output_bytes": 9}}
    policy = policy_from(given, {"processes": 7})
    assert policy == Policy(network="host", limits=Limits(processes=7, output_bytes=9))
    assert policy_from({"gpu": True}, Limits(processes=7)).limits == Limits(processes=7)


def test_limits_said_twice_are_refused() -> None:
    """An object says all of them: neither of two can be meant to be dropped."""
    given = {"limits": {"processes": 5}}
    with pytest.raises(PolicyError, match="give one of them"):
        policy_from(given, Limits(processes=7))
    assert policy_from(given, Limits(processes=5)).limits.processes == 5


def test_mappings_and_objects_mean_the_same() -> None:
    """What can be written as a mapping can be written as an object."""
    policy = Policy(gpu=True, limits=Limits(processes=9))
    assert policy_from({"gpu": True, "limits": {"processes": 9}}, None) == policy
    assert policy_from(policy, None) is policy
    assert limits_from(None) is None
    assert timeouts_from({"close_s": 1}) == Timeouts(close_s=1)


def test_only_named_variables_get_a_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """Variables are granted by name; what is not set is not granted."""
    monkeypatch.setenv("GRANTED", "yes")
    monkeypatch.setenv("SECRET", "no")
    monkeypatch.delenv("UNSET", raising=False)
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


@pytest.mark.parametrize(
    "values",
    [
        {"output": ""},
        {"output": 5},
        {"output": None},
        {"crash_history": -1},
        {"crash_history": 1.5},
        {"crash_history": True},
        {"crash_folder": b"crashes"},
        {"crash_folder": ""},
    ],
)
def test_where_output_and_bundles_go_is_checked(values: dict[str, Any]) -> None:
    with pytest.raises(PolicyError, match=next(iter(values))):
        Policy(**values)


def test_paths_may_be_path_objects() -> None:
    """They become text, as everything in a policy that crosses to another process."""
    policy = Policy(output=Path("a/b.log"), crash_folder=Path("c"))  # type: ignore[arg-type]
    assert (policy.output, policy.crash_folder) == ("a/b.log", "c")


def test_sizes_may_have_a_unit() -> None:
    """In a file of TOML and in Python as on the command line; what is no size may not."""
    policy = policy_from({"limits": {"memory_bytes": "4G"}}, {"disk_bytes": "512 MiB"})
    assert (policy.limits.memory_bytes, policy.limits.disk_bytes) == (4 << 30, 512 << 20)
    with pytest.raises(PolicyError, match="processes is '4K'"):
        policy_from(None, {"processes": "4K"})


def test_lists_of_any_class_are_lists() -> None:
    """A configuration of Hydra's has ``ListConfig``, which is a sequence and no list."""
    names = {"environment": ["HF_HOME"], "readable": ["/srv"], "gpu": [1]}
    made = policy_from({name: UserList(given) for name, given in names.items()}, None)
    assert (made.environment, made.readable, made.gpu) == (("HF_HOME",), ("/srv",), (1,))
    for text in ("HF_HOME", b"HF_HOME"):
        with pytest.raises(PolicyError, match="takes a list of strings"):
            Policy(environment=text)  # type: ignore[arg-type]
