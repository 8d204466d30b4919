"""A server that is told to end lets nothing new in, lets what runs end, and loses no client."""

import contextlib
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import ServerBusyError, WorkerDiedError
from envhub_worker.extras.access import keys
from envhub_worker.protocol import messages as m
from tests.remote.listening import Listening, listening, worker
from tests.remote.peers import peer
from tests.support.ports import lasting_port
from tests.support.processes import eventually
from tests.support.started import started

_LONG = ("--drain-s", "600")


def ends(server: Listening) -> bool:
    return eventually(lambda: server.process.poll() is not None)


def operations(server: Listening) -> set[str]:
    return {jail["operation"] for one in server.sessions() for jail in one["jails"]}


def draining(server: Listening) -> bool:
    """Whether it has said that it takes nothing new."""
    return eventually(lambda: "info draining " in server.said())


def test_what_runs_goes_on_and_nothing_new_comes_in(tmp_path: Path, repository: Path) -> None:
    """The refusal is typed; with the last jail the server ends, long before its time is up. Who
    tells it a second time only waits."""
    with listening(tmp_path / "server", *_LONG) as server:
        pair = keys.load(server.state / "client.key")
        with started(repository, sandbox=server.sandbox()) as env:
            for _ in range(2):
                done = worker("drain", "--state-dir", server.state, "--no-wait")
                assert done.returncode == 0, done.stderr
                assert draining(server)
            with pytest.raises(ServerBusyError, match="takes no new work") as caught:
                make_env(repository, n_envs=2, sandbox=server.sandbox())
            assert caught.value.quota == "draining"
            with peer(server, pair) as stranger:
                refused = stranger.refused(m.Hello(m.VERSION, b"new"))
                assert (refused.error, refused.missing) == ("ServerBusyError", "draining")
            assert env.step(np.array([0]))[0].tolist() == [[1.0]]
            assert server.process.poll() is None
        assert ends(server)
        assert server.process.returncode == 0


def test_whose_time_is_up_is_told_why(tmp_path: Path, repository: Path) -> None:
    """Its jail is ended before the server is, and not with a connection that is lost."""
    with listening(tmp_path / "server", "--drain-s", "1") as server:
        with started(repository, sandbox=server.sandbox()) as env:
            env.step_async(np.array([6000]))
            # else a machine that stands still meanwhile has nobody left who could be told
            assert eventually(lambda: "step" in operations(server))
            server.process.terminate()
            with pytest.raises(WorkerDiedError, match="the server ends") as caught:
                env.step_wait()
            assert caught.value.reason == "idle"
        assert ends(server)


@pytest.mark.parametrize(
    ("options", "numbers"),
    [((), [signal.SIGTERM]), (_LONG, [signal.SIGTERM, signal.SIGTERM]), (_LONG, [signal.SIGINT])],
)
def test_a_second_signal_ends_at_once(
    tmp_path: Path,
    repository: Path,
    options: tuple[str, ...],
    numbers: list[signal.Signals],
    wait_no_more: Callable[[], None],
) -> None:
    """So does the first, if no time was given to what runs, and Ctrl-C always."""
    with (
        listening(tmp_path / "server", *options) as server,
        started(repository, sandbox=server.sandbox()) as env,
    ):
        for number in numbers[:-1]:
            server.process.send_signal(number)
            assert draining(server)
        server.process.send_signal(numbers[-1])
        assert ends(server)
        wait_no_more()
        with pytest.raises(WorkerDiedError):
            env.step(np.array([0]))


def test_drain_is_told_to_the_server_of_the_state_folder(tmp_path: Path) -> None:
    """``envhub-worker drain`` waits for its end, and says so where there is none to be told."""
    with listening(tmp_path / "server", *_LONG) as server:
        done = worker("drain", "--state-dir", server.state)
        assert done.returncode == 0, done.stderr
        assert server.process.wait(60) == 0
        assert "info draining " in server.said()
        done = worker("drain", "--state-dir", server.state)
        assert done.returncode == 1
        assert "is running here" in done.stderr
    with listening(tmp_path / "open", "--insecure-loopback") as server:
        done = worker("drain", "--state-dir", server.state)
        assert done.returncode == 1
        assert "SIGTERM" in done.stderr


# --- two servers, restarted one after the other -----------------------------------------------


class Player(threading.Thread):
    """A client that plays episodes until it is told to stop; what ends it is kept."""

    def __init__(self, make: Callable[[], Any]) -> None:
        super().__init__()
        self.make = make
        self.enough = threading.Event()
        self.episodes = 0
        self.deaths = 0
        self.lost: BaseException | None = None

    def run(self) -> None:
        """An episode that its server took along is played again."""
        try:
            with self.make() as suites:
                while not self.enough.is_set():
                    with contextlib.suppress(WorkerDiedError):
                        self._play(suites.env)
        except BaseException as error:
            self.lost = error

    def _play(self, env: Any) -> None:
        try:
            env.reset(seed=1)
            for count in range(1, 6):
                self.enough.wait(0.02)  # the servers' starts have the cores; it is in an episode
                assert env.step(np.array([0]))[0].tolist() == [[float(count)]]
        except WorkerDiedError:
            self.deaths += 1
            raise
        self.episodes += 1

    def goes_on(self) -> bool:
        """Whether it plays on from here; False if it has ended."""
        before = self.episodes
        return eventually(lambda: self.lost is not None or self.episodes > before + 2, 120) and (
            self.lost is None
        )


def test_a_rolling_restart_loses_nobody(tmp_path: Path, repository: Path) -> None:
    """Each server drains and another takes its port and its keys; ``on_reset`` does the rest."""
    with contextlib.ExitStack() as stack:
        options = ("--drain-s", "1")
        places = [(tmp_path / name, f"tcp://127.0.0.1:{lasting_port()}") for name in ("one", "two")]
        running = [stack.enter_context(ending(*place, options)) for place in places]
        servers = [server for server, _ in running]
        with _client(repository, servers[0]):
            pass  # its snapshot is there: what is tried here is not how many make it at once
        players = [Player(lambda server=server: _client(repository, server)) for server in servers]
        try:
            for player in players:
                player.start()
            assert [player.goes_on() for player in players] == [True] * 2, _lost(players)
            for place, (server, end) in zip(places, running, strict=True):
                server.process.terminate()
                assert ends(server)
                end()
                stack.enter_context(ending(*place, options))
                assert [player.goes_on() for player in players] == [True] * 2, _lost(players)
        finally:
            for player in players:
                player.enough.set()
            for player in players:
                player.join(120)
        assert [player.lost for player in players] == [None] * 2
        assert all(player.deaths for player in players)


def _client(repository: Path, server: Listening) -> Any:
    policy = {"restart": "on_reset", "restart_backoff_s": 0.01}
    return make_env(repository, sandbox=server.sandbox(), policy=policy)


def _lost(players: list[Player]) -> str:
    return repr([player.lost for player in players])


@contextlib.contextmanager
def ending(folder: Path, bind: str, options: tuple[str, ...]) -> Any:
    """A server that may be ended before the others are, and the function that notes it."""
    with contextlib.ExitStack() as stack:
        yield stack.enter_context(listening(folder, *options, bind=bind)), stack.close
