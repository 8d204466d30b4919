"""Our half of slabs that a server has: what it sends is what the runner wrote, and no more."""

import mmap
import os
import struct
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox import errors
from envhub_sandbox.extras.remote import served_lane
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import JailHandle
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.replies import RunnersDiedError
from envhub_sandbox.transport.results import Results
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.supervisor.served_slabs import ServedSlabs
from tests.attacks.client.lying_server import env_manifest
from tests.support.in_process.fake_server import FakeServer, Frames

COUNT = 3
SMALL = spaces.Box(-1, 1, (4,), np.float64)
LARGE = spaces.Dict(
    {
        "image": spaces.Box(0, 255, (300, 200, 3), np.uint8),
        "mask": spaces.Box(0, 1, (200_001,), np.bool_),
        "state": spaces.Box(-1, 1, (7,), np.float32),
    }
)
ACTIONS = spaces.Dict({"a": spaces.Discrete(3), "b": spaces.Box(-1, 1, (2,), np.float32)})


class Both:
    """The client's shard, the server's slabs, and what a runner does with these."""

    def __init__(self, space: Any) -> None:
        self.layout = slabs.layout_of(ACTIONS, COUNT)
        self.observed = slabs.observation_layout(space, COUNT, 1)
        self.shard = served_lane.ServedShard(self.layout, self.observed)
        self.batch = served_lane.ReceivedBatch(space, [self.shard])
        self.server = ServedSlabs(*self.shard.sizes)
        self.memory = [
            memoryview(memory(fd, size))
            for fd, size in zip(
                self.server.deposit,
                (self.layout.request_bytes, slabs.REPLY_BYTES, self.observed.total_bytes),
                strict=False,
            )
        ]

    def ask(self, *leaves: Any) -> None:
        frame = self.shard.ask(leaves, 0)
        assert self.server.fits(frame)
        self.server.ask(frame, "owner")

    def answer(self, outcome: int = slabs.DONE, infos: bytes = b"", length: int = -1) -> Any:
        reply = self.memory[1]
        start = slabs.HEADER_BYTES
        reply[start : start + len(infos)] = infos
        words = slabs.words(reply)
        words[slabs.OUTCOME] = outcome
        words[slabs.LENGTH] = len(infos) if length < 0 else length
        return self.shard.read([bytes(one) for one in self.server.take()[1]])


def memory(fd: int, size: int) -> mmap.mmap:
    """A slab as the jail maps it; that of requests to be read alone."""
    try:
        return mmap.mmap(fd, size)
    except PermissionError:
        return mmap.mmap(fd, size, prot=mmap.PROT_READ)


@pytest.mark.parametrize("space", [SMALL, LARGE], ids=["small", "large"])
def test_a_batch_is_what_the_runner_wrote(space: Any) -> None:
    """Byte for byte, in one frame or in several; booleans are booleans, and all is the caller's."""
    both = Both(space)
    both.ask(np.array([0, 1, 2]), np.ones((COUNT, 2), np.float64))
    both.memory[2][:] = wrote = os.urandom(both.observed.total_bytes)
    assert both.answer() == (slabs.DONE, None)
    observation = both.batch.take()
    rewards, terminations, truncations = both.batch.results()
    leaves = [observation] if space is SMALL else list(observation.values())
    for leaf, array in zip(both.observed.leaves, leaves, strict=True):
        raw = wrote[leaf.offset : leaf.offset + array.nbytes]
        kind = np.frombuffer(raw, array.dtype if array.dtype != np.bool_ else np.uint8)
        expected = kind.astype(array.dtype).reshape(leaf.shape)
        assert array.tobytes() == expected.tobytes()
        assert array.flags.writeable
        assert array.flags.owndata
    start = both.observed.results
    assert rewards.tobytes() == wrote[start : start + 8 * COUNT]
    flags = np.frombuffer(wrote, np.uint8, 2 * COUNT, start + 8 * COUNT).astype(np.bool_)
    assert [*terminations, *truncations] == flags.tolist()


def test_actions_arrive_with_their_dtypes() -> None:
    both = Both(SMALL)
    changes = []
    for integers in (np.int64, np.int8, np.int8):
        both.ask(np.array([0, 1, 2], integers), np.full((COUNT, 2), 0.5, np.float32))
        words = slabs.words(both.memory[0])
        changes.append(words[slabs.CHANGES])
        found = []
        for index, leaf in enumerate(both.layout.actions):
            dtype = slabs.ACTION_DTYPES[words[slabs.DTYPES + index]]
            found.append(slabs.view(both.memory[0], leaf, dtype).copy())
        assert [one.dtype for one in found] == [integers, np.float32]
        assert found[0].tolist() == [0, 1, 2]
        assert found[1].tolist() == [[0.5, 0.5]] * COUNT
        both.server.owner = None
    assert changes[0] < changes[1] == changes[2]


def test_a_space_without_members_has_no_actions_to_write() -> None:
    layout, observed = slabs.layout_of(spaces.Dict({}), 1), slabs.observation_layout(SMALL, 1, 1)
    assert served_lane.ServedShard(layout, observed).ask([], 0)


def test_columns_follow_their_schema() -> None:
    both = Both(SMALL)
    infos = {"a": np.arange(COUNT), "_a": np.ones(COUNT, bool)}
    both.ask(np.zeros(COUNT, int), np.zeros((COUNT, 2)))
    both.answer(infos=bytes(m.pack(m.Value(infos))[0]))
    both.ask(np.zeros(COUNT, int), np.zeros((COUNT, 2)))
    columns = np.array([7, 8, 9]).tobytes().ljust(64, b"\0") + b"\1\2\0"  # a mask is not read
    assert both.answer(slabs.COLUMNS, columns, length=0) == (slabs.COLUMNS, None)
    found = both.shard.columns()
    assert (found["a"].tolist(), found["_a"].tolist()) == ([7, 8, 9], [True] * COUNT)
    fresh = served_lane.ServedShard(both.layout, both.observed)
    assert (both.shard.known > 0, fresh.known) == (True, 0)
    with pytest.raises(errors.RemoteProtocolError, match="before their schema"):
        fresh.columns()


class Served:
    """A lane to a runner for each sub-environment, over a server whose answers a test gives."""

    def __init__(self, shards: int = 1) -> None:
        self.server = FakeServer()
        runners, bounds = range(1, shards + 1), [(at, at + 1) for at in range(shards)]
        jail = JailHandle(self.server, 1, runners, [], DEFAULT_LIMITS)
        manifest = env_manifest(
            single_observation_space=SMALL, single_action_space=spaces.Discrete(99), num_envs=shards
        )
        results = Results(manifest, bounds)
        lane = served_lane.ServedLane.open(Lane(jail, runners, 7, results), Deadline(0))
        assert isinstance(lane, served_lane.ServedLane)
        self.lane, self._shards = lane, shards

    def step(self, action: int = 0, *, ahead: bool = False) -> bool:
        """Send one; whether the server is to take it."""
        self.lane.send_step(np.full(self._shards, action), ahead=ahead)
        return self.server.sent[-1][0].stepped

    def reward(self) -> float:
        self.lane.wait(Deadline(0))
        observation, rewards, *_ = self.lane.result()
        assert observation.shape == (self._shards, *SMALL.shape)
        return float(rewards[0])

    def by_message(self) -> None:
        assert self.step()
        self.lane.expect_more()
        assert not self.lane.takes_more
        self.server.answer(slab())
        assert self.reward() == 0
        assert not self.step()
        assert self.lane.takes_more


def slab(outcome: int = slabs.DONE, reward: float = 0, said: m.Message | None = None) -> Frames:
    infos = b"" if said is None else bytes(m.pack(said)[0])
    layout = slabs.observation_layout(SMALL, 1, 1)
    batch = bytearray(layout.total_bytes)
    struct.pack_into("<d", batch, layout.results, reward)
    return [struct.pack("<QQ", outcome, len(infos)) + infos + batch]


def told(**changes: Any) -> Frames:
    no = np.zeros(1, np.bool_)
    fields = {"observation": np.zeros((1, 4)), "rewards": np.zeros(1), "info": {}}
    return m.pack(m.StepDone(**{**fields, "terminations": no, "truncations": no, **changes}))


INFOS = m.pack(m.Value({"a": np.arange(1), "_a": np.ones(1, np.bool_)}))
RAISED = m.RaisedException("ValueError", "ValueError", "no", "", "step")


def test_several_steps_go_as_messages_and_one_through_slabs() -> None:
    served = Served()
    assert not served.lane.takes_more
    served.by_message()
    for number in (1, 2, 3):
        assert not served.step(number, ahead=True)
    actions = [m.unpack(frames).actions.tolist() for _, frames in served.server.sent[1:]]
    assert actions == [[0], [1], [2], [3]], "none was written into one slab with another"
    for place in (3, 2, 1, 0):  # whichever comes first
        served.server.answer(told(rewards=np.full(1, 10.0 + place)), at=1 + place)
    assert [served.reward() for _ in range(4)] == [10, 11, 12, 13]
    served.lane.expect_more()
    assert not served.step()
    served.server.answer(told())
    served.reward()
    assert served.step()
    assert not served.lane.takes_more
    served.server.answer(slab(reward=5))
    assert served.reward() == 5


def test_several_runners_take_one_step_at_a_time() -> None:
    """And so does a jail that is kept: what fresh ones repeat is the last request alone."""
    kept, two = Served(), Served(2)
    kept.lane.jail.kept = True
    for served in (kept, two):
        for _ in range(3):
            served.lane.expect_more()
            assert served.step()
            assert not served.lane.takes_more
            served.server.answer(*[slab()] * len(served.lane.runners))
            served.reward()


def test_what_came_as_a_message_is_checked() -> None:
    """Before and after steps that were read out of slabs, which is the control."""
    lies: list[dict[str, Any]] = [
        {"observation": np.zeros((1, 5))},
        {"observation": "x"},
        {"rewards": np.zeros(2)},
        {"rewards": None},
        {"terminations": np.zeros(1)},
        {"truncations": np.zeros((1, 3), np.bool_)},
    ]
    for lie in lies:
        served = Served()
        served.by_message()
        served.step(ahead=True)
        served.server.answer(told(), at=-2)
        served.server.answer(told(**lie))
        assert served.reward() == 0
        with pytest.raises(errors.RemoteProtocolError):
            served.reward()


@pytest.mark.parametrize("ahead", [False, True])
def test_infos_that_are_fetched_are_infos(ahead: bool) -> None:
    """A runner may not put a whole step in their place: its rewards would be nobody's to check."""
    for lie in (told(rewards=np.zeros(9)), told(), m.pack(m.Done()), m.pack(m.Value([1]))):
        served = Served()
        served.step()
        served.server.answer(slab(slabs.FETCH))
        assert not ahead or not served.lane.answered()
        sent = _answering(served.server, lie)
        with pytest.raises(errors.RemoteProtocolError):
            served.reward()
        assert len(sent) == 2
    served = Served()
    served.step()
    served.server.answer(slab(slabs.FETCH, reward=3))
    assert not ahead or not served.lane.answered()
    _answering(served.server, INFOS)
    served.lane.wait(Deadline(0))
    assert served.lane.result()[4]["a"].tolist() == [0]


def _answering(server: FakeServer, frames: Frames) -> list[Any]:
    """Answer the fetch, which was sent or is to be; all that was."""
    if len(server.sent) == 2:
        server.answer(frames)
        return server.sent
    send = server.send

    def sent(message: m.Message, payload: Frames = ()) -> int:
        request_id = send(message, payload)
        server.answer(frames)
        return request_id

    server.send = sent
    return server.sent


def test_who_only_looks_has_infos_fetched_once() -> None:
    """It is not answered before these have come; a wait takes them, and asks for nothing."""
    served = Served()
    served.step()
    assert not served.lane.answered()
    served.server.answer(slab(slabs.FETCH, reward=3))
    for _ in range(3):
        assert not served.lane.answered()
    assert len(served.server.sent) == 2
    served.server.answer(INFOS)
    assert served.lane.answered()
    assert (served.reward(), len(served.server.sent)) == (3, 2)
    assert served.step(), "it is as before"
    served.server.answer(slab(reward=4))
    assert served.lane.answered()
    assert served.reward() == 4


def test_infos_that_never_come_are_waited_for_no_longer_than_a_step() -> None:
    served = Served()
    served.step()
    served.server.answer(slab(slabs.FETCH))
    assert not served.lane.answered()
    for wait in (served.lane.wait, served.lane.catch_up):
        with pytest.raises(errors.WorkerTimeoutError):
            wait(Deadline(0))
    served.server.answer(INFOS)
    served.lane.catch_up(Deadline(0))
    assert served.lane.answered(), "nothing is owed"
    assert served.server.untaken == 0


@pytest.mark.parametrize("kind", [slabs.RAISED, slabs.FETCH, slabs.DONE])
def test_infos_that_were_asked_for_in_vain_are_dropped(kind: int) -> None:
    """Because another has raised, whatever it says of that: a client would keep them for ever."""
    served = Served(2)
    served.step()
    served.server.answer(slab(slabs.FETCH), slab(kind, said=RAISED))
    assert not served.lane.answered()
    asked = [runner for runner, _ in served.server.sent[-1][0].parts]
    assert asked == ([1, 2] if kind == slabs.FETCH else [1])
    served.server.answer(*[INFOS] * len(asked))
    assert served.lane.answered()
    served.lane.wait(Deadline(0))
    with pytest.raises(errors.RemoteEnvError, match="no"):
        served.lane.result()
    assert served.server.untaken == 0
    served.step()
    served.server.answer(slab(reward=1), slab(reward=2))
    assert served.reward() == 1


@pytest.mark.parametrize("ahead", [False, True])
def test_who_dies_before_its_infos_came_has_died(ahead: bool) -> None:
    served = Served(3)
    served.lane.jail.kept = True
    served.step()
    served.server.answer(slab(reward=1), slab(slabs.FETCH), slab(slabs.FETCH, reward=3))
    died = m.RelayDone((1, len(INFOS)), (0,)), m.pack(m.Death(2, "exit", 1)), INFOS
    if ahead:
        assert not served.lane.answered()
        served.server.reply(*died, to=served.server.ids[-1])
        assert served.lane.answered()
    else:
        served.server.reply(*died, to=served.server.ids[-1] + 1)
    with pytest.raises(RunnersDiedError) as caught:
        served.lane.wait(Deadline(0))
    assert list(caught.value.deaths) == [1]
    first, second, third = caught.value.replies
    assert second is None
    assert (first.rewards.tolist(), third.info["a"].tolist()) == ([1], [0])


def test_what_cannot_be_sent_or_was_interrupted_is_met_by_the_wait() -> None:
    """To look raises nothing; how much of an interrupted message has left is not known."""
    served = Served()
    served.step()
    served.server.answer(slab(slabs.FETCH))
    served.server.refuses = errors.WorkerError("the worker took no request")
    assert served.lane.answered()
    with pytest.raises(errors.WorkerError, match="took no request"):
        served.lane.wait(Deadline(0))
    served = Served()
    served.step()
    served.server.answer(slab())
    served.server.torn = True
    with pytest.raises(errors.WorkerError, match="interrupted while it was sent"):
        served.lane.catch_up(Deadline(0))
