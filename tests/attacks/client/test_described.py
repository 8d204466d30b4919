"""A hostile worker that describes spaces, specs and generators in its answers.
The controls make of the same fields what they ask for: there memory is asked for without end, a
command runs, and what one message may cost is not what its parts cost one by one."""

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import msgpack
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.vector import space_copies
from envhub_sandbox.vector.space_copies import SpaceCopies
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.codec.wire import GENERATOR, SPACE, SPEC
from envhub_worker.protocol.limits import WireLimits
from envhub_worker.protocol.spaces.spaces import NUMBER, encode_space
from tests.attacks.client.lies import STATES, nested, pcg64, refuses, relayed, spec_of, started
from tests.attacks.client.lying_server import Frames, LyingServer
from tests.support.wire import ext, packed, value

HUGE = 1 << 30


@dataclass
class Lie:
    """What a worker calls the description of a thing."""

    code: int
    value: object


def frames_of(value: object) -> Frames:
    """A result in which lies stand for things; by a worker that knows no limits."""

    def write(thing: object) -> tuple[int, object] | None:
        return (thing.code, thing.value) if isinstance(thing, Lie) else None

    fields = [m.Value.kind, (value, None)]
    found = encode(fields, describer=write, limits=WireLimits(depth=1000))
    return [bytes(frame) for frame in found]


def box(shape: tuple[int, ...], dtype: str = "float32") -> dict[str, Any]:
    zero, one, no = (np.zeros((), dtype), np.ones((), dtype), np.zeros((), bool))
    bounds = {"low": zero, "high": one, "bounded_below": no, "bounded_above": no}
    return {"kind": "box", "dtype": dtype, "shape": shape, **bounds}


def deep(levels: int) -> Frames:
    document = (b"\x92" + msgpack.packb(ext(SPACE))) * levels + b"\xc0"
    return [bytes(frame) for frame in value(document)]


# some: test_spaces, test_names and test_values have all that a description may be
LIES: dict[str, Frames] = {
    "2^60 elements": frames_of(Lie(SPACE, box((HUGE, HUGE)))),
    "more than the budget together": frames_of(
        [Lie(SPACE, {"kind": "multi_binary", "n": 9_000_000})] * 8
    ),
    "too many": packed([m.Value.kind, [[ext(SPACE), {"kind": "tuple", "spaces": []}]] * 60_000]),
    "nested too deep": frames_of(Lie(SPACE, nested(13))),
    "nested 10000 deep": deep(10_000),
    "of no kind": frames_of(Lie(SPACE, {"kind": "trap"})),
    "a spec's steps as text": frames_of(Lie(SPEC, {"id": "A-v0", "max_episode_steps": "7"})),
    "a generator that there cannot be": frames_of(Lie(GENERATOR, STATES["a short key"])),
    "a generator that is none": frames_of(Lie(GENERATOR, STATES["nothing"])),
    "two descriptions at once": packed([m.Value.kind, [ext(SPACE), {}, {}]]),
    "a description without one": packed([m.Value.kind, [ext(SPACE)]]),
    "a code that there is not": packed([m.Value.kind, [ext(29), {}]]),
    "a number as text": frames_of(Lie(SPACE, {**box((2,)), "number": "1"})),
    "a number without end": frames_of(Lie(SPACE, {**box((2,)), "number": 1 << 63})),
    "as a key": packed([m.Value.kind, {(ext(SPEC), 5): 1}]),
}


@pytest.mark.parametrize("what", LIES)
def test_lies_about_things_are_refused(liar: LyingServer, folder: str, what: str) -> None:
    """In what is asked for, and in infos; within bounded memory, and the jail is given up."""
    for ask in ("get_attr", "envs"):
        liar.lies = {m.Call: relayed(LIES[what]), m.GetOne: relayed(LIES[what])}
        with started(liar, folder) as env:
            error = refuses(
                lambda env=env, ask=ask: (
                    env.get_attr("space") if ask == "get_attr" else env.envs[0].space
                )
            )
            assert isinstance(error, RemoteProtocolError), what


def test_what_is_honest_is_taken(liar: LyingServer, folder: str) -> None:
    """The control: the same way of telling, without the lie."""
    honest = [
        Lie(SPACE, box((2,))),
        Lie(SPACE, nested(12)),
        Lie(SPEC, {"id": "A-v0"}),
        Lie(GENERATOR, pcg64()),
    ]
    kinds = [spaces.Box, spaces.Tuple, EnvSpec, np.random.Generator]
    for lie, kind in zip(honest, kinds, strict=True):
        liar.lies[m.Call] = relayed(frames_of(lie))
        with started(liar, folder) as env:
            assert isinstance(env.get_attr("thing")[0], kind)
    one = Lie(SPACE, {"kind": "multi_binary", "n": 9_000_000})
    liar.lies[m.Call] = relayed(frames_of(one))
    with started(liar, folder) as env:
        assert env.get_attr("thing")[0].n == one.value["n"]


def test_the_control_takes_the_memory() -> None:
    with pytest.raises((MemoryError, ValueError)):
        spaces.Box(0, 1, (HUGE, HUGE))


def test_described_specs_make_nothing(liar: LyingServer, folder: str, tmp_path: Path) -> None:
    """Of a spec only facts are taken; the control makes the whole of it, and a command runs. One
    whose id ``gym.make`` would import, which stands before a colon, is only told."""
    canary = tmp_path / "made"
    liar.lies[m.Call] = relayed(frames_of(Lie(SPEC, spec_of(canary))))
    with started(liar, folder) as env:
        spec = env.get_attr("spec")[0]
        assert (spec.id, spec.max_episode_steps) == ("Trap-v0", 7)
        with pytest.raises(gym.error.Error, match="sandbox"):
            gym.make(spec)
        liar.lies[m.Call] = relayed(frames_of(Lie(SPEC, {"id": "antigravity:Trap-v0"})))
        assert not hasattr(env.get_attr("spec")[0], "id")
    assert not canary.exists()
    with pytest.raises(Exception):  # noqa: B017,PT011  # what it returns is no environment
        gym.make(EnvSpec(**spec_of(canary)))
    assert canary.exists(), "the control failed: the entry point was not called"


def test_a_number_makes_no_space_another(liar: LyingServer, folder: str) -> None:
    """1 is the number of the single action space. The control is equal to it, and is that space."""
    equal = encode_space(spaces.Discrete(2))
    for described in (box((2,)), equal):
        liar.lies[m.GetOne] = relayed(frames_of(Lie(SPACE, {**described, "number": 1})))
        with started(liar, folder) as env:
            own = env.single_action_space
            assert (env.envs[0].space[0] is own) is (described is equal)
            assert env.single_action_space is own == spaces.Discrete(2)


@pytest.mark.parametrize(
    "large",
    [
        lambda: spaces.Box(0, 1, (1 << 17,), np.float32),  # its bounds
        lambda: spaces.Text(1, charset="".join(map(chr, range(1 << 13)))),  # a set, a list, a dict
        lambda: spaces.Dict({"k" * (3 << 17): spaces.Discrete(2)}),
        lambda: spaces.Dict({tuple(range(1 << 14)): spaces.Discrete(2)}),
    ],
    ids=["bounds", "characters", "key", "tuple"],
)
def test_numbers_fill_no_memory(
    large: Callable[[], gym.Space[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The client forgets large spaces before they are many; with a higher bound it keeps all."""

    def kept() -> int:
        copies, sent = SpaceCopies(), []
        for number in range(200):
            space = large()
            vars(space)[NUMBER] = number, []
            sent.append(weakref.ref(copies.of(space)))
        del space
        return sum(each() is not None for each in sent)

    assert 1 <= kept() <= 2 * space_copies.MAX_BYTES >> 20
    monkeypatch.setattr(space_copies, "MAX_BYTES", 1 << 40)
    assert kept() == 200, "the control failed: it keeps what it may"
