"""A hostile worker among others: ready always, or never, or twice. The others' results come.
The jail of one sub-environment replaces our code in its process. Control: a step, which waits for
all, is held up by the same worker, so it does what it is meant to."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import errors, make_env
from envhub_worker.protocol.shared_memory import slabs
from tests.attacks.harness import TIMEOUTS, Arena
from tests.attacks.repositories import write_environment
from tests.remote.listening import listening
from tests.support import inside
from tests.support.compare import assert_same

FAMILY = "The client, from inside a jail"
HOSTILE, COUNT, STEPS = 1, 3, 40
PATIENCE_S = 2.0
_ENV = """
import os, threading, time
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.runner import lane, runner

MODE = {mode!r}
BY_MESSAGE = ("twice by message", "never by message", "unlike")  # no slabs, so that steps are these
LARGE = "x" * 300_000

class Counting(Plain):
    def __init__(self, index):
        self.index, self.count = index, 0
        if index == {hostile}:
            become_hostile()

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return super().reset(seed=seed)

    def step(self, action):
        self.count += 1
        seen = np.full(2, self.count * (self.index + 1) / 1e6, np.float32)
        return seen, float(action), False, False, {{"count": self.count}}

def make_env(n_envs=1, use_async_envs=False):
    return VECTOR([lambda i=i: Counting(i) for i in range(n_envs)])

def become_hostile():
    honest_serve, honest_answer = lane.Lane.serve, runner.Runner.answer
    threads = []

    def serve(self):
        stepping = not self._asked[slabs.MESSAGE]
        if self._asked[slabs.SEQUENCE] == self._served or not stepping:
            return honest_serve(self)
        told, asked = self._told, self._asked
        if MODE == "never":
            time.sleep(600)
        if MODE == "always" and not threads:
            def keep_up():
                while True:
                    told[slabs.OUTCOME], told[slabs.LENGTH] = slabs.DONE, 0
                    told[slabs.SEQUENCE] = asked[slabs.SEQUENCE]
            threads.append(threading.Thread(target=keep_up, daemon=True))
            threads[0].start()
        if MODE in ("always", "rings"):
            while True:
                try:
                    os.write(self._client_bell, (1).to_bytes(8, "little"))
                except OSError:
                    os.read(self._client_bell, 8)
        if MODE == "twice":
            self._served = asked[slabs.SEQUENCE]
            told[slabs.OUTCOME], told[slabs.LENGTH] = slabs.DONE, 0
            told[slabs.SEQUENCE] = self._served + 1
            os.write(self._client_bell, (2).to_bytes(8, "little"))
            return True
        if MODE in ("elsewhere", "whole", "impossible"):
            self._served = asked[slabs.SEQUENCE]
            kind = 77 if MODE == "impossible" else slabs.FETCH
            told[slabs.OUTCOME], told[slabs.LENGTH] = kind, 0
            told[slabs.SEQUENCE] = self._served
            os.write(self._client_bell, (1).to_bytes(8, "little"))
            return True
        return honest_serve(self)

    def answer(self, packet):
        request = m.unpack(packet.frames)
        if isinstance(request, m.FetchInfos) and MODE in ("elsewhere", "silent elsewhere"):
            time.sleep(600)
        if isinstance(request, m.FetchInfos) and MODE == "whole":
            nothing = np.zeros(1, bool)
            return m.pack(m.StepDone("lie", np.full(9, 7.0), nothing, nothing, {{}}))
        if isinstance(request, m.Attach) and MODE in BY_MESSAGE:
            list(map(os.close, self.descriptors))
            return m.pack(m.Value(False))
        if not isinstance(request, m.Step):
            return honest_answer(self, packet)
        if MODE == "twice by message":
            frames = honest_answer(self, packet)
            stream = next(fd for fd in range(3, 64) if is_stream(fd))
            os.write(stream, b"".join(map(bytes, runner.pack_packet(packet.request_id, frames))))
            return frames
        if MODE == "unlike":
            nothing = np.zeros(1, bool)
            infos = {{"count": np.zeros((1, 50_000)), "_count": np.ones((1, 3)), "x": {{}}}}
            seen = np.zeros((1, 2), np.float32)
            return m.pack(m.StepDone(seen, np.zeros((1, 9)), nothing, nothing, infos))
        time.sleep(600)

    def is_stream(fd):
        import stat
        try:
            return stat.S_ISSOCK(os.fstat(fd).st_mode)
        except OSError:
            return False

    lane.Lane.serve, runner.Runner.answer = serve, answer
"""


def liar(folder: Path, mode: str) -> str:
    return str(write_environment(folder / mode, _ENV.format(mode=mode, hostile=HOSTILE)))


class Among:
    """An environment with a hostile worker, once it is at its step."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self._has_answered = False
        env.reset(seed=1)

    def receive(self) -> Any:
        received = self.env.recv(1)
        self._has_answered |= HOSTILE in received.env_ids
        return received

    def ask_again_if_it_has_answered(self) -> None:
        """Another step of the hostile one, where it owes none."""
        if self._has_answered:
            self.env.send(np.zeros(1, np.int64), [HOSTILE])
            self._has_answered = False

    def others_go_on(self) -> list[Any]:
        """Steps of the honest ones, for as long as they need; what came of the hostile one."""
        env = self.env
        env.send(np.zeros(COUNT, np.int64))
        of_it: list[Any] = []
        counts = dict.fromkeys((0, 2), 0)
        while min(counts.values()) < STEPS:
            try:
                received = self.receive()
            except errors.EnvHubError as error:
                of_it.append(_of_the_hostile(error))
                continue
            again = []
            for place, index in enumerate(received.env_ids.tolist()):
                if index == HOSTILE:
                    of_it.append(received.infos)
                    continue
                counts[index] += 1
                again.append(index)
                seen = np.full(2, counts[index] * (index + 1) / 1e6, np.float32)
                assert_same(seen, received.observations[place], "observation")
                assert received.infos["count"][place] == counts[index]
            if again:
                env.send(np.full(len(again), 3), again)
        return of_it


def _of_the_hostile(error: errors.EnvHubError) -> errors.EnvHubError:
    assert error.env_ids == (HOSTILE,)
    return error


@contextmanager
def among(strict: Arena, folder: str, lane: str, **options: Any) -> Iterator[Any]:
    """Three sub-environments, each with a worker of its own; the way to them may be TCP."""
    given = {"min_ready": 1, "policy": {"profile": strict.profile}, **options}
    with ExitStack() as stack:
        if lane == "tcp":
            with_keys = stack.enter_context(listening(Path(folder).parent / "server"))
            given["sandbox"] = with_keys.sandbox()
        else:
            given["policy"] = {**given["policy"], "lane": lane}
        yield stack.enter_context(make_env(folder, COUNT, timeouts=TIMEOUTS, **given))


NEVER = [
    *(("auto", mode) for mode in ("never", "rings", "elsewhere", "twice")),
    *(("frames", mode) for mode in ("never", "elsewhere", "never by message")),
    ("tcp", "elsewhere"),
]


@pytest.mark.parametrize(("lane", "mode"), NEVER)
def test_who_is_never_ready_holds_none_up(strict: Arena, home: Path, lane: str, mode: str) -> None:
    folder = liar(home, mode)
    with among(strict, folder, lane) as suites:
        found = Among(suites.env)
        with inside.hurried_part(suites.env, HOSTILE, step_s=PATIENCE_S):
            late = found.others_go_on()  # unless they took longer than a step of it may
            if not late:
                with pytest.raises(errors.WorkerTimeoutError) as caught:
                    found.env.recv(COUNT)
                late = [_of_the_hostile(caught.value)]
        assert [type(one) for one in late] == [errors.WorkerTimeoutError]
    with among(strict, folder, lane, min_ready=None, num_workers=COUNT) as suites:
        suites.env.reset(seed=1)
        with inside.hurried(suites.env, step_s=1.0), pytest.raises(errors.WorkerTimeoutError):
            suites.env.step(np.zeros(COUNT, np.int64))  # the control: it holds up a step of all


def test_who_is_always_ready_has_its_own_results_alone(strict: Arena, tmp_path: Path) -> None:
    with among(strict, liar(tmp_path, "always"), "auto") as suites:
        found = Among(suites.env)
        of_it = found.others_go_on()
        while not of_it:
            received = found.env.recv(1)
            of_it += [received.infos] if HOSTILE in received.env_ids else []
        assert "count" not in of_it[0], "the control: it has answered a step that it never made"


@pytest.mark.short("strict")
@pytest.mark.parametrize("lane", ["auto", "frames", "tcp"])
def test_who_shares_its_jail_and_is_never_ready_holds_nobody_up(
    strict: Arena, home: Path, lane: str
) -> None:
    with among(strict, liar(home, "never"), lane, min_ready=None, num_workers=COUNT) as suites:
        assert not Among(suites.env).others_go_on()


@pytest.mark.short("strict")
@pytest.mark.parametrize("mode", ["twice by message", "unlike"])
def test_who_shares_its_jail_and_breaks_a_rule_has_nobody_elses_results(
    strict: Arena, tmp_path: Path, mode: str
) -> None:
    """The jail is given up; what had come of the others before is theirs."""
    with among(strict, liar(tmp_path, mode), "auto", min_ready=None, num_workers=COUNT) as suites:
        counts = [0] * COUNT

        def receive() -> None:
            received = suites.env.recv(1)
            for place, index in enumerate(received.env_ids.tolist()):
                counts[index] += 1
                seen = np.full(2, counts[index] * (index + 1) / 1e6, np.float32)
                assert_same(seen, received.observations[place], "observation")

        def receive_all() -> None:
            while True:
                receive()

        suites.env.reset(seed=1)
        suites.env.send(np.zeros(1, np.int64), [0])
        receive()  # the control
        suites.env.send(np.zeros(COUNT, np.int64))
        suites.env.send(np.zeros(COUNT, np.int64))
        with pytest.raises((errors.RemoteProtocolError, errors.WorkerDiedError)) as caught:
            receive_all()
        assert HOSTILE in (caught.value.env_ids or ())


BROKEN = [
    ("frames", "twice by message"),
    ("frames", "unlike"),
    *((lane, mode) for lane in ("auto", "frames") for mode in ("impossible", "whole")),
]


@pytest.mark.parametrize(("lane", "mode"), BROKEN)
def test_who_breaks_a_rule_ends_alone(strict: Arena, tmp_path: Path, lane: str, mode: str) -> None:
    with among(strict, liar(tmp_path, mode), lane) as suites:
        found = Among(suites.env)
        given_up = [one for one in found.others_go_on() if isinstance(one, errors.EnvHubError)]
        deadline = time.monotonic() + 120
        while not given_up:
            assert time.monotonic() < deadline
            try:
                found.ask_again_if_it_has_answered()
            except errors.WorkerDiedError:  # its second answer came when it owed none
                break
            try:
                found.receive()
            except errors.EnvHubError as error:
                given_up.append(_of_the_hostile(error))
        with pytest.raises(errors.WorkerError) as refused:
            found.env.send(np.zeros(1, np.int64), [HOSTILE])
        assert isinstance(refused.value, errors.WorkerDiedError)


@pytest.mark.parametrize("word", ["SEQUENCE", "OUTCOME"])
def test_an_answer_that_is_taken_back_holds_nobody_up(
    strict: Arena, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, word: str
) -> None:
    """It was there, and a jail writes its slab whenever it likes: as if there were none yet, or as
    if there were more elsewhere, which never comes."""
    value = {"SEQUENCE": 0, "OUTCOME": slabs.FETCH}[word]
    with among(strict, liar(tmp_path, "silent elsewhere"), "auto") as suites:
        found = Among(suites.env)
        lane: Any = inside.parts(suites.env)[HOSTILE].lease.lane
        changed = inside.written_later(lane, getattr(slabs, word), value)
        monkeypatch.setattr(lane, "answered", changed)
        of_it = found.others_go_on()
        while not of_it:
            try:
                received = found.env.recv(1)
                of_it += [received.infos] if HOSTILE in received.env_ids else []
            except errors.EnvHubError as error:
                of_it.append(_of_the_hostile(error))
        wanted = dict if word == "SEQUENCE" else errors.RemoteProtocolError
        assert isinstance(of_it[0], wanted), "it was waited for"


def test_the_lie_about_infos_would_break_a_batch() -> None:
    """The control: joined with others' as they are, these raise."""
    lie = {"count": np.zeros((1, 50_000)), "_count": np.ones((1, 3))}
    honest = {"count": np.ones(1, np.int64), "_count": np.ones(1, np.bool_)}
    for key in ("count", "_count"):
        with pytest.raises(ValueError, match="dimension"):
            np.concatenate([lie[key], honest[key]])
