"""What is made of deaths: who the server says has died, seeds for the fresh, rows of the dead."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.errors import RemoteProtocolError, WorkerDiedError
from envhub_sandbox.extras.restart.recovery import SeedBook, derived_seed, resets, revived_step
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import JailHandle
from envhub_sandbox.transport.replies import RunnersDiedError
from envhub_sandbox.transport.results import Results
from envhub_sandbox.transport.values import DescriptionReader
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.spaces.spaces import OpaqueSpace
from envhub_worker.runner.described import described
from tests.attacks.client.lying_server import env_manifest

DIED = m.Death(2, "exit", 3, None, "", "last words", "step")
ASKED = [(1, m.Render(1)), (2, m.Render(1))]
"""What the two runners of a jail are asked."""


class Told:
    """A connection on which the server has said one thing."""

    def __init__(self, reply: m.Message, *parts: m.Message) -> None:
        self.reply = reply
        self.version = m.VERSION
        self.payload: list[Buffer] = [frame for part in parts for frame in m.pack(part)]

    def send(self, message: m.Message, payload: Any = ()) -> int:
        return 1

    def receive(self, request_id: int, deadline: Deadline) -> tuple[m.Message, list[Buffer]]:
        return self.reply, self.payload


def jail(reply: m.Message, *parts: m.Message, kept: bool = True) -> JailHandle:
    client = Told(reply, *parts)
    made = JailHandle(client, 1, [1, 2], [], DEFAULT_LIMITS)
    made.kept = kept
    return made


def sent(said: JailHandle) -> int:
    return said.relay("step", [(runner, said.pack(message)) for runner, message in ASKED])


def test_deaths_come_with_the_answers_of_the_others() -> None:
    """Each in its place: what lived has answered, and of the dead one knows how."""
    said = jail(m.RelayDone((1, 1), (1,)), m.Value(7), DIED)
    with pytest.raises(RunnersDiedError) as caught:
        said.receive(sent(said), Deadline(1))
    assert caught.value.replies == [m.Value(7), None]
    assert list(caught.value.deaths) == [1]
    assert (caught.value.first.exit_code, caught.value.first.log_tail) == (3, "last words")
    with pytest.raises(WorkerDiedError, match="exit code 3") as told:
        said.exchange("step", ASKED, Deadline(1))
    assert type(told.value) is WorkerDiedError


def test_a_runners_word_is_no_death() -> None:
    """A ``Death`` in the place of a living runner is an answer, and an illegal one."""
    said = jail(m.RelayDone((1, 1), (1,)), DIED, DIED)
    with pytest.raises(RunnersDiedError) as caught:
        said.receive(sent(said), Deadline(1))
    assert list(caught.value.deaths) == [1]
    with pytest.raises(RemoteProtocolError, match="a runner sent Death"):
        jail(m.RelayDone((1, 1)), m.Value(7), DIED).exchange("step", ASKED, Deadline(1))


@pytest.mark.parametrize(
    ("reply", "parts"),
    [
        (m.RelayDone((1, 1), (2,)), (m.Value(7), DIED)),
        (m.RelayDone((1, 1), (-1,)), (m.Value(7), DIED)),
        (m.RelayDone((1, 1), (0,)), (m.Value(7), DIED)),
        (m.RelayDone((1, 2), (1,)), (m.Value(7), DIED)),
        (m.RelayDone((2, 0), (1,)), (m.Value(7), DIED)),
    ],
)
def test_false_deaths_are_refused(reply: m.RelayDone, parts: tuple[m.Message, ...]) -> None:
    """Nobody asked, no ``Death``, frames too many or too few."""
    said = jail(reply, *parts)
    with pytest.raises(RemoteProtocolError):
        said.receive(sent(said), Deadline(1))
    said = jail(m.RelayDone((1, 1), (1,)), m.Value(7), DIED, kept=False)
    with pytest.raises(RemoteProtocolError, match="dead runners"):  # it was not asked for
        said.receive(sent(said), Deadline(1))


def test_derived_seeds_are_documented_and_all_different() -> None:
    assert derived_seed(5, 1) == int(np.random.SeedSequence((5, 1)).generate_state(1)[0])
    assert derived_seed(None, 1) is None
    assert len({derived_seed(seed, n) for seed in range(20) for n in range(20)}) == 400


def test_the_last_seed_counts() -> None:
    """A reset without one, or of others only, leaves it; so does a None among seeds."""
    book = SeedBook(3, each=True)
    assert book.derived((0, 3), 1) == [None, None, None]
    book.remember(m.Reset(1, [1, 2, 3], None, None))
    book.remember(m.Reset(1, None, None, None))
    book.remember(m.Reset(1, [7, None, 9], None, None))
    book.remember(m.Reset(1, [8, 8, 8], None, np.array([False, True, False])))
    assert book.derived((0, 3), 4) == [derived_seed(seed, 4) for seed in (7, 8, 9)]
    assert book.derived((1, 2), 4) == [derived_seed(8, 4)]
    for seeds, derived in ((5, derived_seed(5, 1)), ([5], [derived_seed(5, 1)])):
        of_its_own = SeedBook(1, each=False)  # which seeds itself, by a number or a list
        assert of_its_own.derived((0, 1), 1) is None
        of_its_own.remember(m.Reset(1, seeds, None, None))
        assert of_its_own.derived((0, 1), 1) == derived


def test_resets_of_the_fresh_are_those_of_the_dead() -> None:
    """With the caller's seeds, and derived ones where he gave none; before a mask, all of them."""
    plain = m.Reset(1, [5, None], {"a": 1}, None)
    assert resets(plain, [8, 9]) == [m.Reset(1, [5, 9], {"a": 1}, None)]
    assert resets(m.Reset(1, None, None, None), [8, 9]) == [m.Reset(1, [8, 9], None, None)]
    mask = np.array([True, False])
    first, second = resets(m.Reset(1, None, {"a": 1}, mask), [8, 9])
    assert first == m.Reset(1, [8, 9], None, None)
    assert second.mask is mask


def test_rows_of_the_dead_are_truncated_whatever_the_fresh_say() -> None:
    yes = np.ones(2, np.bool_)
    said = m.StepDone(np.zeros((2, 1)), np.full((2, 3), 9.0), yes, ~yes, {"worker_restarted": ~yes})
    row = revived_step(said, 2)
    assert row.rewards.tolist() == [[0.0] * 3] * 2
    assert (row.terminations.tolist(), row.truncations.tolist()) == ([False] * 2, [True] * 2)
    assert row.info["worker_restarted"].tolist() == [True, True]


@pytest.mark.parametrize("shape", [(2, 2), (2, 2**31 - 1)])
def test_a_shape_that_is_only_told_is_not_taken_for_rewards(shape: tuple[int, ...]) -> None:
    """A space of the repository's own costs nothing, whatever it says of itself."""
    no = np.zeros(2, np.bool_)
    told = m.StepDone(np.zeros((2, 1)), OpaqueSpace("a.Space", "Space()", shape), no, no, {})
    frames = m.pack(told, describer=described)
    said = m.unpack(frames, things=DescriptionReader)
    assert isinstance(said, m.StepDone)
    assert getattr(said.rewards, "shape", None) == shape
    assert revived_step(said, 2).rewards.shape == (2,)
    for shardable in (True, False):
        space = spaces.Box(-1, 1, (1,), np.float64)
        found = Results(env_manifest(single_observation_space=space, shardable=shardable), [(0, 2)])
        with pytest.raises(RemoteProtocolError, match="rewards"):
            found.step([said])
