"""What is lied to. A target takes one example's dice and says whether the lie was taken.
It raises ``WrongError`` where a lie did harm; errors of this project are refusals, and anything
else is what must never come out."""

import random
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.hub.listing import FileRecord, Snapshot
from envhub_sandbox.session.error_text import add_author_line
from envhub_sandbox.transport import values
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import JailHandle, open_jail
from envhub_sandbox.transport.remote_warnings import MOST, RemoteWarnings
from envhub_sandbox.transport.replies import (
    RunnersDiedError,
    check_reply,
    death,
    expect_reply,
    raised,
)
from envhub_sandbox.transport.results import Results
from envhub_sandbox.transport.values import DescriptionReader, generator, spec_of
from envhub_sandbox.vector.actions import action_reader
from envhub_sandbox.vector.vector_env import metadata_of
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.codec.wire import GENERATOR, SPACE, SPEC
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.protocol.manifest.manifest import decode_env, decode_manifest
from envhub_worker.protocol.messages.compression import pack_frames, unpack_frames
from envhub_worker.protocol.messages.prefix import MAX_TEXT
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.spaces.spaces import OpaqueSpace, encode_space
from envhub_worker.protocol.stream import StreamReader, pack_packet
from tests.attacks.client.lying_server import env_manifest
from tests.fuzz.mutate import Spoiler, crossing
from tests.fuzz.oracle import WrongError, alike, demand, fits, per_env, usable
from tests.fuzz.traffic import Frames
from tests.support.decode import decode
from tests.unit.protocol.spaces.test_batches import SINGLE_SPACES, parts_of

ELEMENTS = 2_000_000
_SMALL = WireLimits(message_bytes=ELEMENTS)
SIZES = ((3,), (1, 2), (2, 2))


@dataclass
class Dice:
    """One example."""

    rng: random.Random
    corpus: list[Frames]
    messages: list[m.Message]

    @property
    def spoiler(self) -> Spoiler:
        donors = [value for one in self.rng.choices(self.messages, k=3) for value in parts(one)]
        return Spoiler(self.rng, donors)

    def often(self) -> int:
        return self.rng.choice((0, 1, 1, 1, 2, 3))

    def spoiled(self, value: Any) -> Any:
        """A value, spoiled and sent. Raises ``NotSentError`` where the wire does not carry it."""
        spoiler = self.spoiler
        for _ in range(self.often()):
            value = spoiler.value(value)
        return self.sent(value)

    def sent(self, value: Any) -> Any:
        """A value as it arrives. Raises ``NotSentError`` where the wire does not carry it."""
        crosses, value = crossing(value)
        if not crosses:
            raise NotSentError
        return value

    def inside(self, value: list[Any]) -> list[Any]:
        """A list of as many values, some of them spoiled."""
        made, spoiler = list(value), self.spoiler
        for _ in range(self.often() if made else 0):
            index = self.rng.randrange(len(made))
            made[index] = spoiler.value(made[index])
        return list(self.sent(made))


class NotSentError(Exception):
    """No worker could say that."""


def parts(message: m.Message) -> list[Any]:
    return m.values_of(message)


# --- messages, with the memory of what recurs ----------------------------------------------------


def unpack(dice: Dice) -> None:
    """A message that comes again, under other ids, is what it was the first time, or refused."""
    frames = dice.rng.choice(dice.corpus)
    if dice.rng.random() < 0.2:
        spoiler = dice.spoiler
        frames = [*map(bytes, m.pack(m.Value({spoiler.key(): spoiler.key()})))]
    for _ in range(dice.often()):
        frames = dice.spoiler.frames(frames, dice.corpus)
    first = attempt(lambda: m.unpack(frames, things=DescriptionReader))
    for _ in range(3):
        again = attempt(lambda: m.unpack(frames, things=DescriptionReader))
        demand(type(first) is type(again) or is_error(first) == is_error(again) == 1, "another end")
        demand(is_error(first) or alike(parts(first), parts(again)), "another message")
    if is_error(first):
        raise first
    plain = decode(frames, things=DescriptionReader)
    demand(alike(parts(first), plain[1:]), "not what the codec says")
    usable(parts(first))
    whole = [*map(bytes, encode([first.kind, *parts(first)]))]
    for _ in range(3):
        demand([*map(bytes, m.pack(first))] == whole, "packed in another way")


def attempt(action: Callable[[], Any]) -> Any:
    """What it gives, or the error of ours that it raises."""
    try:
        return action()
    except EnvHubError as error:
        return error


def is_error(value: Any) -> bool:
    return isinstance(value, EnvHubError)


# --- results -------------------------------------------------------------------------------------


def results(dice: Dice) -> None:
    """Accepted observations fit their space, in one shard or two; so do rewards and flags."""
    rng = dice.rng
    space = SINGLE_SPACES[rng.choice(sorted(SINGLE_SPACES))]
    sizes = rng.choice(SIZES)
    stops = np.cumsum(sizes).tolist()
    bounds = list(zip([0, *stops], stops, strict=False))
    shardable = rng.random() < 0.8
    found = Results(env_manifest(single_observation_space=space, shardable=shardable), bounds)
    space.seed(rng.randrange(5))
    members = [space.sample() for _ in range(stops[-1])]
    observations = parts_of(space, members, bounds)
    replies = [
        m.StepDone(
            observation,
            np.zeros(size),
            np.zeros(size, bool),
            np.zeros(size, bool),
            lasts(members[:size], shardable),
        )
        for observation, size in zip(observations, sizes, strict=True)
    ]
    fields = [dice.inside(parts(reply)) for reply in replies]
    if any(type(one[4]) is not dict for one in fields):
        raise NotSentError
    with UNTRUSTED:
        observation, rewards, over, cut, told = found.step([m.StepDone(*one) for one in fields])
    count = stops[-1]
    if shardable:
        fits(space, observation, count)
        per_env("rewards", rewards, "biuf", count)
        per_env("terminations", over, "b", count)
        per_env("truncations", cut, "b", count)
    usable((observation, rewards, over, cut, told))


def lasts(members: list[Any], shardable: bool) -> dict[Any, Any]:
    """The last observations, as a slice sends them, or joined by a repository's own class."""
    if shardable:
        return {row: {"final_obs": member} for row, member in enumerate(members)}
    made = np.full(len(members), None, object)
    for index, member in enumerate(members):
        made[index] = member
    return {"final_obs": made, "_final_obs": np.ones(len(members), bool)}


def infos(dice: Dice) -> None:
    """One shard's lies do not reach another's rows, and there is one entry each."""
    rng = dice.rng
    sizes = rng.choice(SIZES)
    stops = np.cumsum(sizes).tolist()
    joins = Results(env_manifest(), list(zip([0, *stops], stops, strict=False)))
    honest = [_infos(size, rng) for size in sizes]
    lies = [dice.spoiled(part) for part in honest]
    if any(type(part) is not dict for part in lies):
        raise NotSentError
    given = [honest[0], *lies[1:]] if rng.random() < 0.5 else lies
    joined = joins.infos(given)
    _check_joined(joined, stops[-1])
    if given[0] is honest[0]:
        alone = joins.infos([honest[0], *({} for _ in sizes[1:])])
        for key, value in alone.items():
            if type(value) is np.ndarray:
                mine = joined[key][: sizes[0]]
                demand(alike(list(mine), list(value[: sizes[0]])), f"{key} of the other shard")
    usable(joined)


def _infos(size: int, rng: random.Random) -> dict[Any, Any]:
    """What a shard sends: columns, or each sub-environment's own."""
    if rng.random() < 0.5:
        info = {"speed": 0.5, "count": np.int64(3)}
        columns = batches.flat_infos([(index, info) for index in range(size)], size)
        assert columns is not None
        return columns
    own: dict[Any, Any] = {
        "speed": 0.5, "name": "a", "pos": np.ones(3, np.float32), (1, 2): 0.0,
        "deep": {"x": 1, "y": {"z": 0.5}},
    }  # fmt: skip
    forms = {"deep": ("_deep", False, {"x": ("_x", True, {})})}
    own = {key: own[key] for key in own if rng.random() < 0.8}
    return batches.own_infos([(index, own) for index in range(size)], size, [forms] * size)


def _check_joined(joined: dict[Any, Any], count: int) -> None:
    for key, value in joined.items():
        if type(value) is dict:
            _check_joined(value, count)
        else:
            demand(type(value) is np.ndarray and len(value) == count, f"{key!r} of another length")


def restore(dice: Dice) -> None:
    """Members and batches of any space get their classes back, or are refused; the rest is kept."""
    space = SINGLE_SPACES[dice.rng.choice(sorted(SINGLE_SPACES))]
    space.seed(dice.rng.randrange(5))
    members = [space.sample() for _ in range(3)]
    [batch] = parts_of(space, members, [(0, 3)])
    value, lie = dice.inside([members[0], batch])
    with UNTRUSTED:
        usable(batches.restore(space, value))
        restored = batches.restore_batch(space, lie)
        usable(restored)
        if batches.conforms(space, lie, 3):
            fits(space, restored, 3)


# --- manifests -----------------------------------------------------------------------------------


def manifest(dice: Dice) -> None:
    """What is accepted of a description can be shown, compared, drawn from and stepped."""
    loaded = [one for one in dice.messages if isinstance(one, m.LoadDone)]
    value = dice.spoiled(dice.rng.choice(loaded).manifest)
    if dice.rng.random() < 0.2 and type(value) is dict and type(value.get("envs")) is tuple:
        value["envs"] *= dice.rng.choice((2, 50))
    found = decode_manifest(value, max_elements=ELEMENTS, generator=generator)
    usable((found.interpreter, found.packages))
    for env in found.envs:
        usable((env.metadata, env.attributes, env.render_mode, env.suite, env.task))
        metadata_of(env)
        spec = spec_of(env.spec)
        entry = f"{values.__name__}:{values.not_here.__name__}"
        demand(spec is None or spec.entry_point == entry, "an entry point of the worker's")
        for space in (env.single_observation_space, env.single_action_space):
            repr(space)
            demand(space == space, "a space that is not itself")
        action_reader(env, min(env.num_envs, 64))


def built(dice: Dice) -> None:
    """The same for the answer to ``Build``."""
    found = [one for one in dice.messages if isinstance(one, m.BuildDone)]
    decode_env(dice.spoiled(dice.rng.choice(found).manifest), max_elements=ELEMENTS)


def things(dice: Dice) -> None:
    """What is described in an answer is made of facts, costs what it may, and can be used."""
    code, honest = dice.rng.choice(
        [
            *((SPACE, encode_space(space)) for space in SINGLE_SPACES),
            (SPEC, {"id": "A-v0", "max_episode_steps": 7}),
            (GENERATOR, dict(np.random.PCG64(7).state)),
        ]
    )
    made = DescriptionReader(_SMALL)(code, dice.spoiled(honest))
    usable(made)
    if isinstance(made, gym.Space) and not isinstance(made, OpaqueSpace):
        made.sample()
    if isinstance(made, EnvSpec):
        demand("not_here" in str(made.entry_point), "an entry point of the worker's")
    if isinstance(made, np.random.Generator):
        made.integers(0, 9, 700)


def generators(dice: Dice) -> None:
    """A generator that is accepted draws numbers, and ends nobody."""
    kinds = (np.random.PCG64, np.random.MT19937, np.random.Philox, np.random.SFC64)
    state = dice.rng.choice(kinds)(7).state
    lie = dice.spoiled(dict(state))
    made = generator(lie)
    made.random(700)
    made.integers(0, 2**31, 3, dtype=np.int32)
    made.standard_normal(3)
    made.shuffle(np.arange(5))
    repr(made.bit_generator.state)


# --- what the server relays ----------------------------------------------------------------------


class _Server:
    """In the place of a connection: what is to be answered."""

    def __init__(self, answer: Callable[[], tuple[m.Message, list[Any]]]) -> None:
        self._answer = answer

    def send(self, message: m.Message, payload: object = ()) -> int:
        return 1

    def receive(self, request_id: int, deadline: Deadline) -> tuple[m.Message, list[Any]]:
        return self._answer()

    def request(self, message: m.Message, *, deadline: Deadline) -> tuple[m.Message, list[Any]]:
        return self._answer()

    def hold(self, jail: int) -> None:
        """Nothing is held."""


def relay(dice: Dice) -> None:
    """As many messages as runners were asked, or deaths of some of these; or an error."""
    rng = dice.rng
    runners = rng.choice((1, 2))
    runner_replies = [rng.choice(dice.corpus) for _ in range(runners)]
    counts = tuple(map(len, runner_replies))
    died = m.Death(1, "exit", 3, None, "", "", "step")
    answers: list[m.Message] = [
        m.RelayDone(counts), m.RelayDone(counts, (0,)), died,
        m.Refusal("SandboxUnavailableError", "x", "y", "z"),
        m.JailOpened(1, tuple(range(runners)), ()),
    ]  # fmt: skip
    if rng.random() < 0.3:
        runner_replies[0] = [bytes(frame) for frame in m.pack(died)]
    reply = spoiled_message(dice, rng.choice(answers))
    payload = [frame for frames in runner_replies for frame in frames]
    if rng.random() < 0.3:
        payload = payload[: rng.randrange(len(payload) + 1)]
    server: Any = _Server(lambda: (reply, payload))
    jail = JailHandle(server, 1, range(runners), [], DEFAULT_LIMITS)
    jail.kept = rng.random() < 0.5
    if isinstance(reply, m.JailOpened):
        asked = m.OpenJail("", "", "", "", "", {}, runners)
        opened = open_jail(server, asked, DEFAULT_LIMITS, Deadline(None))
        demand(len({*opened.runners}) == runners, "other runners")
        return
    request = jail.relay("step", [(runner, []) for runner in range(runners)])
    try:
        found = jail.receive(request, Deadline(None))
    except RunnersDiedError as error:
        demand(set(error.deaths) <= set(range(runners)), "the death of nobody")
        raise
    demand(len(found) == runners, "more answers than runners")
    for one in found:
        check_reply(one)


def warnings(dice: Dice) -> None:
    """What is told of warnings is short, plain text, however it is said; the reply is the same."""
    rng, heard = dice.rng, RemoteWarnings()
    reply = rng.choice(dice.corpus)
    for _ in range(rng.randrange(1, 9)):
        some = [(f"UserWarning {rng.random()}", "x" * rng.randrange(3000)) for _ in range(3)]
        told = m.Warnings(tuple(dice.inside(list(some))))
        front = attempt(lambda told=told: m.pack(told))
        if is_error(front):
            raise NotSentError
        frames = [*front, *reply]
        if rng.random() < 0.3:
            frames = dice.spoiler.frames(frames, dice.corpus)
        rest = heard.take(frames)
        demand(list(rest) in (list(frames), list(frames[1:])), "another reply")
    demand(len(heard.unshown) <= MOST + 1, "a flood")
    for one in heard.unshown:
        demand(tuple(map(type, one)) == (str, str), "no text")
        demand(max(map(len, one)) <= MAX_TEXT, "a giant")


def spoiled_message(dice: Dice, message: m.Message) -> m.Message:
    """A message, spoiled, as far as its class permits it."""
    fields = dice.inside(parts(message))
    frames = attempt(lambda: m.pack(type(message)(*fields)))
    if is_error(frames):
        raise NotSentError
    return m.unpack(frames)


def server(dice: Dice) -> None:
    """What the server says of deaths and refusals is text, whatever it says."""
    rng = dice.rng
    message = spoiled_message(dice, rng.choice(dice.messages))
    if isinstance(message, m.Death):
        usable(str(death(message)))
    wanted = rng.choice((m.Done, m.RelayDone, m.JailOpened, m.Welcome))
    usable(str(attempt(lambda: expect_reply(message, wanted))))
    check_reply(message)


_PIECES = (
    *(
        '  File "env.py", line 3, in step\n    x\n',
        '  File "',
        '", line ',
        ", in ",
        "env.py",
        "9" * 12,
    ),
    *("/store/tree/env.py", "lib/a.py", "../env.py", "/home/me/train.py", "x" * 300, "\n", "  | "),
    *("Traceback (most recent call last):\n", "\x1b[2J", "\r", "\u202e", "\x00", '"', "\ud800"),
)
_FILES = tuple(FileRecord(path, 1, "sha256:0") for path in ("env.py", "lib/a.py"))
_SNAPSHOT = Snapshot("/home/me/env", "local", "local-1", "env.py", Path("/store/tree"), _FILES)


def tracebacks(dice: Dice) -> None:
    """What a worker tells of an exception is text, and leads to its repository's own files only."""
    rng = dice.rng
    text = "".join(rng.choices(_PIECES, k=rng.choice((3, 10, 40, 4000))))
    stage = rng.choice(("step", "import", "make_env"))
    error: Any = raised(m.RaisedException("ValueError", text[:600], text[:9000], text, stage))
    add_author_line(error, _SNAPSHOT)
    for told in (str(error), *vars(error).get("__notes__", ())):
        demand(all(one in "\n\t" or one.isprintable() for one in told), "a control character")
        demand(len(told) < 200_000, "a text without end")  # each line has a margin
    remote: Any = error if stage == "step" else error.__cause__
    own = (
        r'  File "/home/me/env/(env|lib/a)\.py", line [0-9]+(, in [^\n]*)?(\n    [^\n]*)?(\n +\^+)?'
    )
    demand(not remote.where or re.fullmatch(own, remote.where), "another file")


# --- the stream ----------------------------------------------------------------------------------


def stream(dice: Dice) -> None:
    """However the bytes are cut, the same packets come out, or the stream is refused."""
    rng = dice.rng
    whole = b"".join(
        bytes(part)
        for number, frames in enumerate(rng.choices(dice.corpus, k=3))
        for part in pack_packet(number, frames)
    )
    for _ in range(dice.often()):
        whole = dice.spoiler.raw(whole) if rng.random() < 0.9 else rng.randbytes(200)
    once, cut = _read(whole, [len(whole)]), _read(whole, _cuts(whole, rng))
    demand(once == cut, "other packets, where the bytes were cut elsewhere")
    if once[1]:
        raise once[1][0]


def _cuts(data: bytes, rng: random.Random) -> list[int]:
    return [*sorted(rng.randrange(len(data) + 1) for _ in range(rng.randrange(1, 9))), len(data)]


class _Same(EnvHubError):
    """Two refusals are the same: where in the bytes each came differs."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same)

    __hash__ = EnvHubError.__hash__


def _read(data: bytes, cuts: list[int]) -> tuple[list[Any], list[_Same]]:
    reader, found, start = StreamReader(), [], 0
    try:
        for stop in cuts:
            for packet in reader.feed(data[start:stop]):
                found.append((packet.request_id, [bytes(frame) for frame in packet.frames]))
            start = stop
    except EnvHubError as error:
        return found, [_Same(str(error))]
    return found, []


def packed(dice: Dice) -> None:
    """Compressed frames come back as they were, or within the limits, or not at all."""
    rng, limits = dice.rng, WireLimits(frame_bytes=1 << 20, message_bytes=2 << 20)
    frames = [*rng.choice(dice.corpus), bytes(40_000), rng.randbytes(20_000)]
    travelling = [bytes(frame) for frame in pack_frames(frames, "lz4")]
    spoilt = dice.often()
    for _ in range(spoilt):
        if rng.random() < 0.5:
            travelling = dice.spoiler.frames(travelling, dice.corpus)
        else:
            index = rng.randrange(len(travelling))
            travelling[index] = dice.spoiler.raw(travelling[index])
    with UNTRUSTED:
        found = unpack_frames(travelling, limits)
    demand(spoilt or list(map(bytes, found)) == frames, "other frames")
    inflated = len(found) != len(travelling)
    demand(not inflated or sum(map(len, found)) <= limits.message_bytes, "more than the limit")


def column_schemas(dice: Dice) -> None:
    """Columns never reach outside of their area, whatever infos announced them."""
    lie = dice.spoiled(_infos(dice.rng.randrange(1, 4), dice.rng))
    if type(lie) is not dict:
        raise NotSentError
    with UNTRUSTED:
        for column in slabs.columns_of(lie) or ():
            end = column.offset + int(np.prod(column.shape, dtype=object)) * column.dtype.itemsize
            demand(0 <= column.offset <= end <= slabs.INFO_BYTES, "a column outside")


TARGETS: dict[str, Callable[[Dice], None]] = {
    one.__name__: one
    for one in (
        unpack, things, results, infos, restore, manifest, built, generators, relay,
        warnings, server, tracebacks, stream, packed, column_schemas,
    )
}  # fmt: skip
__all__ = ["TARGETS", "Dice", "NotSentError", "WrongError"]
