"""A hostile runner in a jail that outlives it: ``restart="transparent"``; one of two shards lies.
What a runner says, or leaves behind that goes on saying it, must count for nobody else: neither for
its sibling, nor for the server, nor for the runner that comes in its place."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError, RemoteProtocolError, WorkerDiedError
from tests.attacks.harness import TIMEOUTS, Arena, kill_named, new_alias, pids_named
from tests.attacks.repositories import write_environment
from tests.support.processes import eventually

FAMILY = "The client, from inside a jail"
FORGED = 666.0
_ENV = """
import ctypes, os, stat, tempfile, time
from pathlib import Path
from envhub_worker.runner import runner
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory import slabs

MODE, ALIAS = {mode!r}, {alias!r}
honest, attach = runner.Runner.answer, runner.Runner.attach
state = {{"liar": False, "ghost": None}}

VECTOR = gym.vector.AsyncVectorEnv

class Counter(Plain):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def reset(self, **given):
        self.steps = 0
        return super().reset(**given)

    def step(self, action):
        self.steps += 1
        if state["liar"] and MODE == "slab" and once():
            haunt(runner_of["lane"])
        return np.array([float(self.steps)]), float(self.steps), False, False, {{}}

def once():
    mark = Path(tempfile.gettempdir(), "done")
    known = mark.exists()
    mark.write_text("")
    return not known

def name_me():
    ctypes.CDLL(None).prctl(15, ALIAS.encode(), 0, 0, 0)  # PR_SET_NAME

def forged():
    row = np.array([{forged!r}])
    no = np.zeros(1, bool)
    return m.StepDone(row.reshape(1, 1), row, no, no, {{}})

def packet(packet_id, message):
    return b"".join(map(bytes, runner.pack_packet(packet_id, m.pack(message))))

def stream():
    return next(fd for fd in range(3, 64) if is_socket(fd))

def is_socket(fd):
    try:
        return stat.S_ISSOCK(os.fstat(fd).st_mode)
    except OSError:
        return False

BACK = Path(tempfile.gettempdir(), "back")

def haunt(lane=None, first=0):
    heard, told = os.pipe()
    if os.fork():
        os.read(heard, 1)  # until it has a session of its own: else it ends with this one
        os._exit(0)
    os.setsid()
    name_me()
    os.write(told, b"x")
    while not BACK.exists():  # what comes before the death is noticed is the runner's own lie
        time.sleep(0.005)
    for number in range(1, 100_000):
        try:
            if lane is None:
                os.write(stream(), packet(first + number % 64, forged()))
            else:
                lane._told[slabs.OUTCOME], lane._told[slabs.LENGTH] = slabs.DONE, 0
                lane._told[slabs.SEQUENCE] = number % 64
        except OSError:
            pass
        time.sleep(0.001)

runner_of = {{}}

def remember(self, request):
    if MODE != "slab":
        list(map(os.close, self.descriptors))
        return m.Value(False)  # so that steps come as messages
    reply = attach(self, request)
    runner_of["lane"] = self.lanes[request.env]
    return reply

def lie(self, received):
    request = m.unpack(received.frames)
    if isinstance(request, m.Build):
        state["liar"] = request.start == 1
        if state["liar"] and Path(tempfile.gettempdir(), "done").exists():
            BACK.write_text("")
    if not state["liar"] or not isinstance(request, m.Step):
        return honest(self, received)
    number = received.request_id
    if MODE == "forge":
        return m.pack(forged())
    if MODE == "died":
        return m.pack(m.Death(1, "signal", None, "SIGKILL", "", "", "step"))
    if MODE == "partly":
        return m.pack(m.RelayDone((1, 1), (0,)))
    if MODE == "twice":
        os.write(stream(), packet(number, forged()) + packet(number + 1, forged()))
        time.sleep(600)
    if MODE == "sibling's":
        os.write(stream(), packet(number - 1, forged()))
        time.sleep(600)
    if MODE == "torn" and once():
        os.write(stream(), packet(number, forged())[:-3])
        os._exit(0)
    if MODE == "ghost" and once():
        haunt(first=number)
    return honest(self, received)

runner.Runner.answer = lie
runner.Runner.attach = remember
runner._HANDLERS[m.Attach] = remember
"""


def stepping(arena: Arena, folder: Path, mode: str, alias: str = "", lane: str = "frames") -> Any:
    """Two sub-environments in a runner each; the second one's runner lies."""
    text = _ENV.format(mode=mode, alias=alias, forged=FORGED)
    return make_env(
        str(write_environment(folder / "liar", text)),
        n_envs=2,
        use_async_envs=True,
        num_workers=2,
        policy={
            "profile": arena.profile,
            "restart": "transparent",
            "crash_history": 0,
            "lane": lane,
        },
        timeouts={**TIMEOUTS, "close_s": 0.5},
    )


def test_forged_rows_are_the_forgers_own(strict: Arena, home: Path) -> None:
    """The control: such an answer is taken, and stands in the row of whoever gave it."""
    with stepping(strict, home, "forge") as suites:
        suites.env.reset()
        assert suites.env.step([0, 0])[1].tolist() == [1.0, FORGED]


@pytest.mark.short("strict")
@pytest.mark.parametrize("mode", ["died", "partly"])
def test_runners_cannot_speak_of_deaths(strict: Arena, home: Path, mode: str) -> None:
    """Only the server says who has died: a runner that does is a liar, and nothing is reset."""
    with stepping(strict, home, mode) as suites:
        suites.env.reset()
        with pytest.raises(RemoteProtocolError):
            suites.env.step([0, 0])
        assert suites.env.sandbox.stats()["restarts"] == 0


@pytest.mark.parametrize("mode", ["twice", "sibling's"])
def test_liars_are_given_no_second_chance(strict: Arena, home: Path, mode: str) -> None:
    """An answer to what was not asked ends the runner, and it is not brought back."""
    with stepping(strict, home, mode) as suites:
        suites.env.reset()
        with pytest.raises(EnvHubError) as caught:
            suites.env.step([0, 0]) and suites.env.step([0, 0])
        assert isinstance(caught.value, WorkerDiedError)
        assert (caught.value.reason, suites.env.sandbox.stats()["restarts"]) == ("protocol", 0)


def test_a_torn_answer_is_nobodys(strict: Arena, home: Path) -> None:
    """Who dies in the middle of an answer has not answered; what follows is not its rest."""
    with stepping(strict, home, "torn") as suites:
        suites.env.reset()
        observation, rewards, _, truncated, _ = suites.env.step([0, 0])
        assert (observation.tolist(), rewards.tolist()) == ([[1.0], [0.0]], [1.0, 0.0])
        assert truncated.tolist() == [False, True]
        after = [suites.env.step([0, 0]) for _ in range(2)]
        assert [got[1].tolist() for got in after] == [[2.0, 0.0], [3.0, 1.0]], after


@pytest.mark.parametrize(
    ("mode", "lane"), [("ghost", "frames"), ("slab", "auto"), ("slab", "frames")]
)
def test_what_a_runner_leaves_behind_speaks_for_nobody(
    arena: Arena, home: Path, mode: str, lane: str
) -> None:
    """A daemon with the dead runner's stream and slabs goes on answering: nobody listens."""
    alias = new_alias()
    try:
        with stepping(arena, home, mode, alias, lane) as suites:
            suites.env.reset()
            first = suites.env.step([0, 0])
            assert eventually(lambda: len(pids_named(alias)) == 1)
            assert first[3].tolist() == [False, True]
            for at in range(20):
                rewards = suites.env.step([0, 0])[1]
                assert np.array_equal(rewards, [at + 2.0, at])
                time.sleep(0.005)
            assert len(pids_named(alias)) == 1, "the daemon has gone: it proves nothing"
        assert eventually(lambda: not pids_named(alias))
    finally:
        kill_named(alias)
