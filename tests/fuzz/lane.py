"""The fast lane's slabs with anything in them: the jail writes what and when it likes."""

from contextlib import suppress
from typing import Any

import numpy as np
from gymnasium import spaces

from envhub_sandbox.transport.results import Results
from envhub_sandbox.transport.shared_memory.client_slabs import (
    LaneShard,
    ObservationSlab,
    SlotRing,
    infos_of,
)
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.messages.forms import IrregularError
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.shared_memory.columns import StepColumns
from envhub_worker.protocol.shared_memory.packets import packet_bytes, write_packet
from tests.attacks.client.lying_server import env_manifest
from tests.fuzz.oracle import demand, fits, per_env, usable
from tests.fuzz.targets import Dice, NotSentError, attempt, is_error, parts, spoiled_message

SPACE = spaces.Dict(
    {"b": spaces.Box(0, 1, (3,), np.bool_), "x": spaces.Box(-1, 1, (2,)), "d": spaces.Discrete(3)}
)
COUNT = 2


class Slabs:
    """One shard's slabs, as the client has them, and as the jail can write them."""

    def __init__(self) -> None:
        observed = slabs.observation_layout(SPACE, COUNT, 1)
        layout = slabs.layout_of(spaces.Discrete(2), COUNT)
        self.observations = ObservationSlab(SPACE, observed)
        self.shard = LaneShard(layout, self.observations.fd)
        self.slots = SlotRing(1, slabs.INFO_BYTES, slabs.INFO_BYTES)
        self.slot = memory(self.slots.fd, slabs.INFO_BYTES)
        self.layout = layout
        self.reply = memory(self.shard.fds[1], slabs.REPLY_BYTES)
        self.batch = memory(self.observations.fd, observed.total_bytes)
        self.results = Results(env_manifest(single_observation_space=SPACE), [(0, COUNT)])


def memory(fd: int, size: int) -> Any:
    """The jail's map of a slab."""
    import mmap

    return np.frombuffer(mmap.mmap(fd, size), np.uint8)


_SLABS: list[Slabs] = []


def lane(dice: Dice) -> None:
    """Outcomes, answers, infos, columns, observations and flags: right, or refused."""
    rng = dice.rng
    if not _SLABS:
        _SLABS.extend((Slabs(), Slabs()))
    ours = rng.choice(_SLABS)
    shard, steps_in_columns = ours.shard, ours is _SLABS[0]
    words = ours.reply[: slabs.HEADER_BYTES].view(np.uint64)
    if rng.random() < 0.3:
        ours.batch[:] = np.frombuffer(rng.randbytes(ours.batch.nbytes), np.uint8)
    message = rng.choice([one for one in dice.messages if one.kind >= m.FIRST_RUNNER_KIND])
    if rng.random() < 0.4:
        size = rng.choice((1, COUNT))
        message = m.Value({"a": np.ones(size), "_a": np.ones(size, bool), "n": np.ones((size, 2))})
        if rng.random() < 0.5:
            finals = np.array([None, None])
            finals[0] = np.ones(2)
            message = m.Value({"final_obs": finals, "final_info": {"r": 0.5}})
    frames = [bytes(frame) for frame in m.pack(spoiled_message(dice, message))]
    if rng.random() < 0.3:
        frames = dice.spoiler.frames(frames, dice.corpus)
    if len(frames) > 1 and rng.random() < 0.8:
        raise NotSentError
    packet = bytearray(packet_bytes(frames))
    write_packet(packet, 0, len(packet), frames)
    packet = bytes(packet)
    if rng.random() < 0.2:
        packet = dice.spoiler.raw(packet)
    _put(ours.reply, slabs.INFOS, frames[0])
    _put(ours.reply, slabs.ANSWER, packet)
    _put(ours.slot, 0, packet)
    if steps_in_columns:
        shard.write([np.zeros(COUNT, np.int64)], (0, 0, 0))
    else:
        shard.write_message(m.pack(m.Render(1)), (0, 0, 0), rng.choice((None, ours.slots)))
    words[slabs.OUTCOME] = rng.choice((1, 2, 3, 4, 4, 0, 5, 5, 2**64 - 1))
    words[slabs.OFFERED], words[slabs.FORM] = 0, rng.choice((0, 1, 1, 2))
    if type(message) is m.Value and rng.random() < 0.7:
        with suppress(IrregularError):
            words[slabs.OFFERED] = StepColumns([message.value], slabs.INFO_BYTES).digest
    in_answer = not steps_in_columns and rng.random() < 0.8
    length = len(packet) if in_answer else len(frames[0])
    words[slabs.LENGTH] = rng.choice((length, length, length, 0, length + 1, 2**16, 2**64 - 1))
    found = attempt(shard.answer) if in_answer else attempt(shard.outcome)
    if is_error(found):
        raise found
    if in_answer:
        usable([] if found is None else parts(found))
        return
    with UNTRUSTED:
        if found[0] == slabs.FETCH:
            found = slabs.DONE, m.Value({})
        infos = ours.results.infos([infos_of(shard, found, ours.results)])
        usable(infos)
        observation = ours.observations.take()
    fits(SPACE, observation, COUNT)
    demand(set(observation["b"].tobytes()) <= {0, 1}, "a boolean that is neither")
    rewards, over, cut = ours.observations.results()
    per_env("rewards", rewards, "f", COUNT)
    per_env("terminations", over, "b", COUNT)
    per_env("truncations", cut, "b", COUNT)


def _put(slab: Any, start: int, data: bytes) -> None:
    room = data[: slabs.INFO_BYTES]
    slab[start : start + len(room)] = np.frombuffer(room, np.uint8)
