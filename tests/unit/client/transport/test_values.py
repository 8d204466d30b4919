"""Spaces, specs and generators in answers: the same on the other side, out of one budget."""

import copy
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from envhub_sandbox.errors import RemoteEnvWarning, RemoteProtocolError
from envhub_sandbox.transport.remote_warnings import MOST, RemoteWarnings
from envhub_sandbox.transport.values import DescriptionReader
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.protocol.codec.wire import SPACE
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.protocol.messages.prefix import WARNINGS
from envhub_worker.protocol.spaces.spaces import OpaqueSpace
from envhub_worker.runner.described import described
from tests.support.compare import assert_same, assert_same_space
from tests.support.wire import ext, packed

SPACES: list[gym.Space[Any]] = [
    spaces.Box(-1, np.inf, (2, 3), np.float16),
    spaces.Discrete(3, start=-5),
    spaces.MultiDiscrete([[2, 3], [4, 5]]),
    spaces.MultiBinary((2, 2)),
    spaces.Text(5, min_length=2, charset="ab"),
    spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Tuple([spaces.Box(0, 1, ())])}),
    spaces.Sequence(spaces.Box(0, 1, (2,)), stack=True),
    spaces.Graph(spaces.Box(0, 1, (2,)), spaces.Discrete(3)),
    spaces.OneOf([spaces.Discrete(2), spaces.MultiBinary(3)]),
]
BITS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")


def arrived(value: object, limits: WireLimits = DEFAULT_LIMITS) -> Any:
    frames = m.pack(m.Value(value), describer=described)
    message = m.unpack(frames, limits=limits, things=DescriptionReader)
    assert isinstance(message, m.Value)
    return message.value


@pytest.mark.parametrize("space", SPACES, ids=repr)
@pytest.mark.parametrize("place", [lambda it: it, lambda it: ({"k": [it]},)], ids=["bare", "deep"])
def test_spaces_arrive(space: gym.Space[Any], place: Callable[[Any], Any]) -> None:
    found = arrived(place(space))
    assert_same_space(space, found if found == space else found[0]["k"][0], "it")
    array = np.full(3, None, dtype=object)  # as infos hold them
    array[0], array[2] = space, spaces.Dict({})
    assert arrived(array).tolist() == array.tolist()


class Custom(gym.Space[Any]):
    """A space that Gymnasium does not know."""


class Own(np.random.Generator):
    """A generator that only its owner knows."""


def test_what_only_its_owner_knows_is_told() -> None:
    assert isinstance(arrived(Custom((2,), np.float32)), OpaqueSpace)
    deep: Any = spaces.Discrete(2)
    for _ in range(20):
        deep = spaces.Tuple([deep])
    for value in (deep, Own(np.random.PCG64()), np.random.RandomState(1), spaces.Discrete):
        assert isinstance(arrived(value), RemoteObject)


@pytest.mark.parametrize("bits", BITS)
def test_generators_arrive(bits: str) -> None:
    original = np.random.Generator(getattr(np.random, bits)(3))
    original.integers(0, 9, 5, np.int32)
    found = arrived((original, None))[0]
    assert_same(original, found, "it")
    assert found.random() == copy.deepcopy(original).random()


def test_specs_arrive_as_facts() -> None:
    """What would make something stays behind; they copy and pickle."""
    given = EnvSpec("a/B-v1", entry_point="os:system", kwargs={"a": 1}, max_episode_steps=7)
    found = arrived(given)
    assert (found.id, found.max_episode_steps, found.name) == ("a/B-v1", 7, "B")
    for spec in (found, copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        assert "system" not in repr(spec)
        with pytest.raises(gym.error.Error, match="in a sandbox"):
            gym.make(spec)


def test_a_message_has_one_budget() -> None:
    """Each space would do; together they cost more than the message may hold."""
    limits = WireLimits(message_bytes=48 << 10)
    space = spaces.Box(0, 1, (3000,))
    assert arrived((space,), limits) == (space,)
    bits = np.random.default_rng(1)
    for many in ((space, spaces.Box(0, 2, (3000,)), space), (EnvSpec("A-v0"),) * 49, (bits,) * 13):
        with pytest.raises(RemoteProtocolError, match="cost more"):
            arrived(many, limits)


def test_nobody_else_makes_anything_of_descriptions() -> None:
    """Whoever was not given what makes them refuses them: a server, a runner, an older client."""
    with pytest.raises(RemoteProtocolError, match="not made here"):
        m.unpack(m.pack(m.Value(spaces.Discrete(2)), describer=described))
    with pytest.raises(RemoteProtocolError, match="not made here"):
        m.unpack(packed([m.Value.kind, [ext(SPACE), {}, "more"]]), things=DescriptionReader)
    plain = m.unpack(m.pack(m.Value(spaces.Discrete(2))), things=DescriptionReader)
    assert isinstance(plain, m.Value)
    assert isinstance(plain.value, RemoteObject)


# --- What a client makes of warnings: Python's own, once each, bounded, where the caller stands


REPLY = m.pack(m.Value(1))


def told(heard: RemoteWarnings, *some: tuple[str, str]) -> list[Any]:
    if some:
        assert heard.take(WARNINGS.put(some, REPLY)) == REPLY
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        heard.show("a/b@c")
    return shown


def test_each_is_told_once() -> None:
    """Whichever process has said it, and however often; at the caller's line, and never painted."""
    heard = RemoteWarnings()
    assert heard.take(REPLY) is REPLY
    [one, other] = told(heard, ("UserWarning", "slow"), ("x.Own", "slow"), ("x.Own", "slow"))
    assert str(one.message) == "a/b@c: UserWarning: slow"
    assert str(other.message) == "a/b@c: x.Own: slow"
    assert one.category is other.category is RemoteEnvWarning
    assert one.filename == __file__, "Python's filters go by that"
    assert told(heard, ("UserWarning", "slow")) == []
    [painting] = told(heard, ("\x1b]0;owned\x07\n", "\x1b[2J\r\u202eslow"))
    assert str(painting.message).isprintable()
    for twin in (copy.copy(one.message), pickle.loads(pickle.dumps(one.message))):
        found = (str(twin), twin.label, twin.category, twin.text)
        assert found == (str(one.message), "a/b@c", "UserWarning", "slow")


def test_a_flood_ends_with_a_word() -> None:
    heard, shown = RemoteWarnings(), []
    for number in range(3 * MOST):
        shown += told(heard, ("UserWarning", str(number)))
    assert len(shown) == MOST + 1
    assert "more than" in str(shown[-1].message)


def test_what_the_filters_raise_leaves_the_rest() -> None:
    """As an error it comes out; what follows is told the next time."""
    heard = RemoteWarnings()
    heard.take(WARNINGS.put([("UserWarning", "one"), ("UserWarning", "two")], REPLY))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RemoteEnvWarning, match="one"):
            heard.show("a/b@c")
    [two] = told(heard)
    assert two.message.text == "two"
