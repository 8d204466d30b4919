"""Which names of a worker become attributes, which facts it tells, and in which forms."""

import builtins
import copy
import pickle
import traceback
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox import errors
from envhub_sandbox.transport import values
from envhub_sandbox.transport.values import spec_of
from envhub_sandbox.vector.send_recv import SendRecv
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.codec.inert import RemoteEnum, RemoteObject
from envhub_worker.protocol.manifest.manifest import (
    MAX_METADATA,
    read_metadata_facts,
    read_spec_facts,
)
from envhub_worker.protocol.manifest.names import GYMNASIUMS, PROBED, is_servable
from tests.support.decode import decode
from tests.unit.protocol.manifest.test_manifest import an_env, read, with_env

HONEST = ("hub_config", "task_description", "task", "language", "_ensure", "_max_episode_steps")


@pytest.mark.parametrize("name", HONEST)
def test_honest_names_are_served(name: str) -> None:
    """What repositories call their attributes, and LeRobot's two with an underscore."""
    assert is_servable(name)


@given(st.text())
def test_no_form_that_is_not_an_identifier_is_served(name: str) -> None:
    if is_servable(name) and name not in HONEST:
        assert name.isidentifier()
        assert not name.startswith("_")
    assert not is_servable(f"_{name}") or f"_{name}" in HONEST
    assert not is_servable(f"__{name}__")


def test_no_name_of_gymnasiums_is_served() -> None:
    for name in (*dir(gym.vector.VectorEnv), "envs", "env_fns", "num_envs", *PROBED):
        assert not is_servable(name), name
    assert set(gym.vector.VectorEnv.__annotations__) <= GYMNASIUMS


def test_manifests_load_without_the_names_that_are_not_served() -> None:
    made = read(with_env("attributes", ("__len__", "_cache", "hub_config", "a b", "_ensure")))
    assert made.envs[0].attributes == ("hub_config", "_ensure")


@pytest.mark.parametrize("field", ["suite", "task"])
@pytest.mark.parametrize(
    "name", ["/etc", "..", "../x", "a/../../x", "a\\..\\x", "\\x", "a/..", "//a"]
)
def test_names_of_tasks_lead_into_no_other_folder(field: str, name: str) -> None:
    with pytest.raises(errors.RemoteProtocolError, match="as a path"):
        read(with_env(field, name))


@pytest.mark.parametrize("name", ["ALE/Pong-v5", "pick cube", "v1..2", "a.b", "...", "", "~"])
def test_names_of_tasks_may_be_anything_else(name: str) -> None:
    assert read(with_env("task", name)).envs[0].task == name


# --- metadata and specs ---------------------------------------------------------------------


def test_metadata_keeps_what_people_read() -> None:
    given = {"render_fps": 30, "render_modes": ["rgb_array"], "robot": {"arms": 2}, "jax": False}
    assert read_metadata_facts(given) == given
    assert read_metadata_facts({"render_fps": np.float32(12.5)}) == {"render_fps": np.float32(12.5)}


@pytest.mark.parametrize(
    ("key", "lie"),
    [
        *(("render_fps", lie) for lie in (np.zeros(3), "30", 0, -1, float("nan"), float("inf"))),
        *(("render_fps", lie) for lie in (10**400, True)),
        *(("render_modes", lie) for lie in ("rgb_array", [1])),
        *(("autoreset_mode", lie) for lie in (np.zeros(2), "NextStep")),
    ],
)
def test_metadata_on_which_gymnasium_acts_is_typed(key: str, lie: object) -> None:
    assert read_metadata_facts({key: lie, "robot": "so100"}) == {"robot": "so100"}


@pytest.mark.parametrize(
    "lie",
    [
        {"a": [0] * MAX_METADATA},
        {"a": np.zeros(MAX_METADATA)},
        {"a": {"b": [[0] * (MAX_METADATA // 2)] * 3}},
        {"a": np.array([[0] * 100] * 100, object)},
        {b"3": 4},
        [],
    ],
    ids=["list", "array", "nested", "objects", "key", "type"],
)
def test_metadata_is_bounded(lie: object) -> None:
    with pytest.raises(errors.RemoteProtocolError):
        read_metadata_facts(lie)


def test_autoreset_modes_that_are_arrays_are_refused() -> None:
    for lie in (np.array(["NextStep", "SameStep"]), np.zeros(3), np.array("NextStep"), []):
        with pytest.raises(errors.RemoteProtocolError):
            read(with_env("autoreset_mode", lie))


def test_specs_keep_their_facts_only() -> None:
    facts = {"id": "X-v0", "max_episode_steps": 5, "reward_threshold": 0.5}
    assert read_spec_facts({**facts, "entry_point": "os:system", "kwargs": {}}) == facts
    numpys = {"max_episode_steps": np.int64(5), "nondeterministic": np.bool_(True)}
    made = read_spec_facts(numpys)
    assert made == {"max_episode_steps": 5, "nondeterministic": True}
    assert [type(value) for value in made.values()] == [int, bool]
    assert read_spec_facts(None) is None


@pytest.mark.parametrize(
    "lie",
    [
        *({"id": lie} for lie in (3, "x" * 513, "\x1b[2J")),
        *({"max_episode_steps": lie} for lie in ("5", True, 2**63, np.zeros(2))),
        *({"reward_threshold": "1"}, {"reward_threshold": 10**400}, {"nondeterministic": 1}),
        "X-v0",
    ],
    ids=repr,
)
def test_specs_of_wrong_types_are_refused(lie: object) -> None:
    with pytest.raises(errors.RemoteProtocolError):
        read_spec_facts(lie)


def test_specs_in_results_make_nothing() -> None:
    made = spec_of(an_env().spec)
    for spec in (made, copy.deepcopy(made), pickle.loads(pickle.dumps(made))):
        assert EnvSpec.from_json(spec.to_json()) == made
        with pytest.raises(gym.error.Error, match="in a sandbox"):
            gym.make(spec)
    assert spec_of(an_env(spec=None).spec) is None
    assert spec_of(an_env(spec={"id": "not an id!"}).spec) is None


# --- generators, stand-ins, errors ----------------------------------------------------------

KINDS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("draws", [0, 1, 7, 700])
def test_every_state_that_a_generator_has_is_taken(kind: str, draws: int) -> None:
    original = np.random.Generator(getattr(np.random, kind)(3))
    original.integers(0, 9, draws, np.int32)  # leaves half a word behind
    state: Any = decode(encode(original.bit_generator.state))
    assert values.generator(state).random() == original.random()


@given(st.sampled_from(KINDS), st.data())
def test_states_with_another_field_are_refused_or_harmless(kind: str, data: st.DataObject) -> None:
    state: Any = getattr(np.random, kind)(3).state
    field = data.draw(st.sampled_from([name for name in state if name != "bit_generator"]))
    inner = state[field] if type(state[field]) is dict else state
    name = data.draw(st.sampled_from(list(inner))) if inner is not state else field
    inner[name] = data.draw(
        st.integers(-(2**130), 2**130) | st.none() | st.floats() | st.text() | st.booleans()
    )
    try:
        made = values.generator(state)
    except errors.RemoteProtocolError:
        return
    made.integers(0, 3, 10_000)


@pytest.mark.parametrize("value", [RemoteObject("a.B", "<b>"), RemoteEnum("a.E", "X", [3])])
def test_stand_ins_are_plain_values(value: RemoteObject) -> None:
    assert copy.deepcopy(value) == copy.copy(value) == pickle.loads(pickle.dumps(value)) == value
    assert hash(copy.deepcopy(value)) == hash(value)
    assert np.asarray(value).item() is value
    for name in ("__array_interface__", "__dlpack__", "_repr_html_", "shape"):
        with pytest.raises(AttributeError, match=r"description of a a\."):
            getattr(value, name)
    assert not hasattr(type(value).__new__(type(value)), "anything")


@pytest.mark.parametrize("builtin", ["AttributeError", "OSError", "KeyError", "no such one"])
def test_remote_errors_keep_their_text(builtin: str) -> None:
    """With where they came from, copied and pickled; the builtin's own fields stay empty."""
    error = errors.remote_error(builtin, "a.Oops", "message", "trace")
    error.args = ("org/repo: a.Oops: message",)
    for made in (pickle.loads(pickle.dumps(error)), copy.deepcopy(error), copy.copy(error)):
        assert type(made) is type(error)
        assert isinstance(made, errors.RemoteEnvError)
        assert (str(made), made.message, made.traceback) == (str(error), "message", "trace")
        for name in ("errno", "filename", "strerror", "name", "obj", "path"):
            assert getattr(made, name, None) is None


def test_remote_errors_are_their_builtin_but_for_what_a_caller_would_miss() -> None:
    """All that Python has, below OSError, too; no error ends a caller's loop or lacks its text."""
    kinds = [kind for kind in vars(builtins).values() if isinstance(kind, type)]
    missed = (StopIteration, StopAsyncIteration, SyntaxError)
    for kind in (kind for kind in kinds if issubclass(kind, Exception)):
        error = errors.remote_error(kind.__name__, kind.__name__, "message")
        assert isinstance(error, kind) is not issubclass(kind, missed)
        assert isinstance(errors.load_error(kind.__name__, "message"), errors.LoadError)
        assert "message" in "".join(traceback.format_exception(error))


def test_the_proxys_own_names_are_never_served() -> None:
    own = {**vars(SandboxVectorEnv), **vars(SendRecv)}
    public = [name for name in own if not name.startswith("_")]
    beyond = {name for name in public if not hasattr(AsyncVectorEnv, name) and is_servable(name)}
    assert beyond == {"prewarm", "recv", "sandbox", "send", "send_reset"}
    for name in ("_session", "_requests", "_manifest", "_timeouts", "_read_actions"):
        assert not is_servable(name)
