"""Manifests: what a repository returned arrives as it was; lies about it do not."""

import dataclasses
import itertools
from typing import Any

import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.limits import MAX_NUM_ENVS
from envhub_worker.protocol.manifest.manifest import (
    MAX_ENVS,
    EnvManifest,
    Manifest,
    decode_env,
    decode_manifest,
    encode_env,
    encode_manifest,
)
from envhub_worker.protocol.manifest.names import MAX_NAME, MAX_NAMES
from tests.support.decode import decode
from tests.support.wire import env_manifest, not_refused

ELEMENTS = 40_000
OBSERVATION = spaces.Dict({"b": spaces.Box(-1, 1, (3,)), "a": spaces.Text(4)})
ACTION = spaces.Discrete(3, start=1)


def an_env(**changed: Any) -> EnvManifest:
    facts: dict[str, Any] = {
        "suite": "libero",
        "metadata": {"render_fps": 30, "render_modes": ["rgb_array"]},
        "render_mode": "rgb_array",
        "spec": {"id": "X-v0", "max_episode_steps": 5},
        "attributes": ("hub_config", "task"),
    }
    return env_manifest(OBSERVATION, ACTION, 2, **(facts | changed))


def a_manifest(*envs: EnvManifest) -> Manifest:
    return Manifest(
        envs=envs or (an_env(),),
        lazy=True,
        interpreter={"version": "CPython 3.11.2"},
        packages={"numpy": "2.4.6"},
    )


def value_of(manifest: Manifest | None = None) -> Any:
    return decode(encode(encode_manifest(manifest or a_manifest())))


def with_env(name: str, value: object) -> Any:
    """A manifest whose environment says ``value`` for ``name``."""
    made = value_of()
    made["envs"][0][name] = value
    return made


def read(value: object) -> Manifest:
    return decode_manifest(value, max_elements=ELEMENTS)


@pytest.mark.parametrize(
    "env",
    [
        an_env(),
        an_env(task="pick cube"),
        an_env(render_mode=None, spec=None, autoreset_mode=None, attributes=()),
        an_env(autoreset_mode="SameStep", metadata={}),
    ],
)
def test_manifests_arrive_as_they_were(env: EnvManifest) -> None:
    manifest = a_manifest(env, an_env(suite="other"))
    assert read(value_of(manifest)) == manifest


def test_one_environment_arrives_as_it_was() -> None:
    value = decode(encode(encode_env(an_env())))
    assert decode_env(value, max_elements=ELEMENTS) == an_env()


def test_only_a_vector_environment_with_a_step_of_its_own_decides_what_a_batch_is() -> None:
    """A worker cannot have the client read actions by another space than it cuts them by."""
    other = spaces.MultiDiscrete([2] * 7)
    assert an_env(shardable=False, action_space=other).own_batch("action_space") == other
    assert an_env(shardable=False).own_batch("action_space") is None
    assert an_env(action_space=other).own_batch("action_space") is None


def test_fields_of_another_type_are_refused() -> None:
    names = [field.name for field in dataclasses.fields(EnvManifest)]
    lies = itertools.product(names, (b"bytes", 1.5, {b"3": 4}, [[]], object))
    assert not_refused(lambda lie: read(with_env(*lie)), lies) == []


LONG = "x" * (MAX_NAME + 1)
LIES: dict[str, tuple[object, ...]] = {
    "num_envs": (0, -1, MAX_NUM_ENVS + 1, True),
    "task": (True, None, LONG),
    "suite": (LONG, None),
    "shardable": (1,),
    "sync": (None,),
    "autoreset_mode": ("Sometimes", 1),
    "metadata": (
        None,
        {LONG: 1},
        {("a", LONG): 1},
        {((1,),): 1},
        {(1,) * 5000: 1},
        {str(number): 1 for number in range(MAX_NAMES + 1)},
    ),
    "render_mode": (3,),
    "spec": ({1: 2}, "X-v0"),
    "attributes": (["a"], ("a", 1), ("a",) * (MAX_NAMES + 1)),
    "type_name": (None,),
    "single_action_space": (None,),
    "observation_space": ({},),
}


def test_impossible_values_are_refused() -> None:
    lies = [(name, lie) for name, lies in LIES.items() for lie in lies]
    assert not_refused(lambda lie: read(with_env(*lie)), lies) == []


def test_what_is_no_manifest_is_refused() -> None:
    lies: list[Any] = [None, [], (), {}, {"envs": ()}, "manifest", 3, {**value_of(), "extra": 1}]
    for name in ("envs", "lazy", "interpreter", "packages"):
        lies.append({**value_of(), name: None})
        lies.append({key: value for key, value in value_of().items() if key != name})
    assert not_refused(read, lies) == []


@pytest.mark.parametrize("envs", [(), (None,) * (MAX_ENVS + 1)], ids=["none", "too many"])
def test_the_number_of_environments_is_bounded(envs: tuple[None, ...]) -> None:
    with pytest.raises(RemoteProtocolError, match="1 to 4096"):
        read({**value_of(), "envs": envs})


def test_a_task_named_twice_is_refused() -> None:
    made = value_of(a_manifest(an_env(), an_env()))
    with pytest.raises(RemoteProtocolError, match="same task twice"):
        read(made)


def test_spaces_of_absurd_size_are_refused_before_they_are_built() -> None:
    large = an_env(observation_space=spaces.Box(0, 1, (ELEMENTS + 1,)))
    with pytest.raises(RemoteProtocolError):
        read(value_of(a_manifest(large)))


def test_package_versions_are_short_text() -> None:
    lies = ({"numpy": 2}, {"numpy": "x" * (MAX_NAME + 1)}, {2: "numpy"}, [])
    assert not_refused(lambda lie: read({**value_of(), "packages": lie}), lies) == []


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=10,
)


@given(st.sampled_from([field.name for field in dataclasses.fields(EnvManifest)]), plain)
def test_arbitrary_fields_raise_nothing_but_protocol_errors(name: str, lie: object) -> None:
    try:
        read(with_env(name, lie))
    except RemoteProtocolError:
        return
