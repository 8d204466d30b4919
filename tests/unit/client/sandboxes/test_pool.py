"""Servers that environments share: started once, kept for their time, and ended once."""

import os
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.extras.docker import container as docker
from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.extras.docker.sandbox import DockerSandbox
from envhub_sandbox.sandboxes import pool as pool_module
from envhub_sandbox.sandboxes.pool import ServerHold, ServerPool, ServerUse, WorkerServer
from envhub_sandbox.settings.policy import Policy
from tests.support import inside
from tests.support.in_process.interrupts import before_line
from tests.support.processes import eventually

Pool = ServerPool["Server"]


class Server(WorkerServer):
    """Remembers who ended it, once; its end can be made to last."""

    runs = True

    def __init__(self) -> None:
        self.ends: list[str] = []
        self.ending, self.may_end = threading.Event(), threading.Event()
        self.may_end.set()

    def stop(self) -> None:
        """An interrupted end is asked for again."""
        self.ending.set()
        assert self.may_end.wait(60)
        self.runs = False
        if not self.ends:
            self.ends.append(threading.current_thread().name)


def given_up(pool: Pool, key: str, idle_s: float | None) -> Server:
    use = pool.acquire(key, Server, idle_s)
    use.release()
    return use.server


def here() -> list[str]:
    """What a server says that was ended once, by this thread."""
    return [threading.current_thread().name]


def waiting() -> list[threading.Thread]:
    """The threads that end servers when their time has come."""
    return [thread for thread in threading.enumerate() if thread.name == "envhub-idle"]


@pytest.fixture
def pool() -> Iterator[Pool]:
    """At the end of a test nothing is kept, and no thread waits."""
    made: Pool = ServerPool()
    yield made
    made.stop_idle()
    assert eventually(lambda: not waiting())


# --- in use --------------------------------------------------------------------------------------


def test_a_dead_one_stays_with_its_users_and_others_get_a_fresh_one(pool: Pool) -> None:
    dead = pool.acquire("key", Server)
    dead.server.runs = False
    fresh = pool.acquire("key", Server)
    assert fresh.server is not dead.server
    assert (dead.users(), fresh.users()) == (1, 1)
    dead.release()
    assert (dead.server.ends, fresh.server.ends) == (here(), [])
    assert pool.acquire("key", Server).server is fresh.server


def test_what_does_not_start_is_not_remembered(pool: Pool) -> None:
    def fails() -> Server:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pool.acquire("key", fails)
    assert pool.acquire("key", Server).users() == 1


def test_a_start_delays_only_those_who_want_the_same(pool: Pool) -> None:
    """A place that waits for room may wait for what another gives back; and one is started once."""
    other = pool.acquire("other", Server)
    begun, may_start, started = threading.Event(), threading.Event(), list[Server]()

    def start() -> Server:
        begun.set()
        assert may_start.wait(60)
        started.append(Server())
        return started[-1]

    uses = list[ServerUse[Server]]()
    acquire = lambda: uses.append(pool.acquire("slow", start))  # noqa: E731
    threads = [threading.Thread(target=acquire) for _ in range(3)]
    for thread in threads:
        thread.start()
    assert begun.wait(60)
    other.release()
    assert other.server.ends == here()
    assert pool.acquire("third", Server).users() == 1
    may_start.set()
    for thread in threads:
        thread.join(60)
    assert len(started) == 1
    assert {use.server for use in uses} == set(started)


def test_all_are_ended_at_exit_and_none_is_kept(pool: Pool) -> None:
    """Those in use and the idle one; and what is started afterwards is a fresh one."""
    idle = given_up(pool, "idle", 600)
    uses = [pool.acquire(key, Server, 600) for key in (1, 2)]
    pool.stop_all()
    assert [idle.ends, *(use.server.ends for use in uses)] == [here()] * 3
    uses[0].release()  # its descriptors may be another's by now
    assert uses[0].server.ends == here()
    late = pool.acquire(1, Server, 600)
    assert late.server is not uses[0].server
    late.release()
    assert late.server.ends == here()


def test_a_fork_has_servers_of_its_own(pool: Pool) -> None:
    """Its parent's stay as they are, in use and idle, and it waits for no lock of another thread:
    of one that its parent has, nor of one of its own."""
    ours, idle = [pool.acquire("key", Server)], given_up(pool, "idle", 600)
    server = ours[0].server
    held, done = threading.Event(), threading.Event()

    def start() -> Server:
        held.set()
        done.wait(60)
        return Server()

    thread = threading.Thread(target=pool.acquire, args=("slow", start))
    thread.start()
    assert held.wait(60)
    child = os.fork()
    if child == 0:  # pragma: no cover
        code = 1
        try:
            threading.Timer(60, os._exit, [1]).start()  # which ends what hangs
            held.clear()
            threading.Thread(target=pool.acquire, args=("other", start)).start()
            assert held.wait(50)
            assert pool.acquire("key", Server).server is not server
            own = given_up(pool, "idle", 0.01)
            assert own is not idle
            assert eventually(lambda: bool(own.ends))
            ours[0].release()
            ours.clear()
            code = int(bool(server.ends or idle.ends))
        finally:
            os._exit(code)
    assert os.waitpid(child, 0)[1] == 0
    done.set()
    thread.join()
    assert (ours[0].users(), server.ends, idle.ends) == (1, [], [])
    assert pool.acquire("idle", Server).server is idle


def test_a_use_that_is_lost_is_given_back(pool: Pool) -> None:
    """A Ctrl-C came between the taking and the noting: its own end gives it back, once."""
    kept, lost = pool.acquire("key", Server), pool.acquire("key", Server)
    server = kept.server
    assert kept.users() == 2
    del lost
    assert (kept.users(), server.ends) == (1, [])
    del kept
    assert server.ends == here()


@pytest.mark.parametrize("then", ["given back again", "forgotten", "another opens"])
def test_an_interrupted_release_is_finished_by_the_next(then: str) -> None:
    """Wherever it was interrupted; it is ended once, and never under one who uses it."""
    line, came = 0, True
    while came:
        pool: Pool = ServerPool()
        use: ServerUse[Server] = pool.acquire("key", Server)
        server = use.server
        came = before_line(pool_module.__file__, line, use.release)
        if then == "another opens":
            again = pool.acquire("key", Server)
            del use
            assert not again.server.ends
            again.release()
            assert again.server.ends == here()
        elif then == "forgotten":
            del use
        else:
            use.release()
        assert server.ends == here()
        line += 1
    assert line > 5


# --- kept for the next ---------------------------------------------------------------------------


def test_its_time_comes(pool: Pool) -> None:
    """It is ended once, in the background, and the thread that did it ends, too. One is kept at
    most: with the next its time has come, however long it was."""
    server = given_up(pool, "key", 0.01)
    assert eventually(lambda: server.ends == ["envhub-idle"])
    assert eventually(lambda: not waiting())
    assert given_up(pool, "key", 0) is not server
    first, second = given_up(pool, "one", None), given_up(pool, "two", None)
    assert eventually(lambda: bool(first.ends))
    assert not second.ends


@pytest.mark.parametrize("idle_s", [600, None])
def test_an_idle_one_that_has_died_is_ended_by_the_next(pool: Pool, idle_s: float | None) -> None:
    """And not when its time has come: until it is waited for, it is a zombie. One that has died in
    use is ended by the one who gives it back."""
    dead = given_up(pool, "key", idle_s)
    dead.runs = False
    fresh = pool.acquire("key", Server, idle_s)
    assert fresh.server is not dead
    assert eventually(lambda: len(dead.ends) == 1)
    assert not fresh.server.ends
    fresh.server.runs = False
    fresh.release()
    assert fresh.server.ends == here()


def test_without_a_thread_for_the_idle_it_ends_at_once(
    pool: Pool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        ended = given_up(pool, "key", 600)
        assert ended.ends == here()
    assert given_up(pool, "key", 600) is not ended


def test_one_that_ends_delays_no_fresh_one(pool: Pool) -> None:
    """Once its time has come it is not handed on; only the end of the process waits for its end."""
    use = pool.acquire("key", Server, 0.01)
    old = use.server
    old.may_end.clear()
    use.release()
    assert old.ending.wait(60)
    fresh = pool.acquire("key", Server)
    assert fresh.server is not old
    threading.Timer(0.1, old.may_end.set).start()
    pool.stop_idle()
    assert old.ends == ["envhub-idle"]
    assert not fresh.server.ends


def test_many_at_once_share_the_idle_one(pool: Pool) -> None:
    """Threads that open and close with times around nothing never meet an ended one."""
    wrong: list[Server] = []

    def use() -> None:
        for attempt in range(100):
            taken = pool.acquire("key", Server, (attempt % 3) * 1e-4)
            if taken.server.ends:
                wrong.append(taken.server)
            taken.release()

    threads = [threading.Thread(target=use) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_only_idle_containers_change_hands(monkeypatch: pytest.MonkeyPatch, pool: Pool) -> None:
    """Its memory is one ``make_env``'s; another policy, or another repository, has its own."""
    monkeypatch.setattr(*inside.CONTAINERS, pool)
    monkeypatch.setattr(*inside.CONTAINER_STARTS, lambda self: Server())
    engine = Engine("docker", "/usr/bin/docker", "1", rootless=False)

    def sandbox(snapshot: str = "/one", **policy: Any) -> docker.RepositoryContainer:
        options, made = DockerSandbox(), Policy(**policy)
        return docker.RepositoryContainer(options, engine, "sha256:0", Path(snapshot), made)

    first, second = sandbox(), sandbox()
    one, two = first.acquire(Path("/"), idle_s=600), second.acquire(Path("/"))
    assert one.server is not two.server
    two.release()
    one.release()
    assert sandbox().acquire(Path("/")).server is one.server
    other = sandbox().acquire(Path("/"), idle_s=600)
    other.release()
    further = sandbox("/two").acquire(Path("/")), sandbox(network="loopback").acquire(Path("/"))
    assert other.server not in [use.server for use in further]
    assert sandbox().acquire(Path("/")).server is other.server


# --- kept from a suite's first jail to its last environment --------------------------------------


@pytest.fixture
def use(pool: Pool) -> Callable[[], ServerUse[Server]]:
    """Gives a use of the one server; a fresh one where it has died."""
    return partial(pool.acquire, "key", Server)


@pytest.fixture
def events() -> list[str]:
    return []


@pytest.fixture
def hold(use: Callable[[], ServerUse[Server]], events: list[str]) -> ServerHold:
    return ServerHold(use, lambda: events.append("enter"), lambda: events.append("empty"))


def test_it_lasts_from_the_first_jail_to_the_last_environment(
    hold: ServerHold, use: Callable[[], ServerUse[Server]], events: list[str]
) -> None:
    """However many jails come and go in between; to leave twice is to leave once."""
    leave_one, leave_two = hold.enter(), hold.enter()
    taken = use()
    server = taken.server
    for _ in range(3):
        hold.keep(server)
    taken.release()
    assert taken.users() == 1
    for _ in range(2):
        leave_one()
    assert not server.ends
    assert events == ["enter"] * 2
    leave_two()
    assert server.ends
    assert events == ["enter"] * 2 + ["empty"]
    hold.keep(server)  # there is no environment that could need it
    assert taken.users() == 0


def test_it_leaves_a_dead_server(hold: ServerHold, use: Callable[[], ServerUse[Server]]) -> None:
    leave = hold.enter()
    dead = use()
    hold.keep(dead.server)
    dead.release()
    dead.server.runs = False
    fresh = use()
    hold.keep(fresh.server)
    assert dead.server.ends
    assert fresh.users() == 2
    fresh.release()
    leave()
    assert fresh.server.ends


def test_an_interrupted_end_is_finished_by_the_next_leave(
    hold: ServerHold, use: Callable[[], ServerUse[Server]], events: list[str]
) -> None:
    """A Ctrl-C came while it waited for a jail that was still ending, and another at the server."""
    leave, further = hold.enter(), hold.enter()
    taken = use()
    server = taken.server
    hold.keep(server)
    taken.release()

    def interrupted() -> None:
        raise KeyboardInterrupt

    assert hold.close_later(server, interrupted)
    further()
    server.stop = interrupted
    with pytest.raises(KeyboardInterrupt):
        leave()
    del server.stop
    assert (server.ends, "empty" in events) == ([], False)
    leave()
    assert server.ends
    assert events[-1] == "empty"


def test_ends_are_waited_for_once(hold: ServerHold, use: Callable[[], ServerUse[Server]]) -> None:
    """Never more than one is left; one that the garbage collector adds meanwhile is not lost."""
    leave, further = hold.enter(), hold.enter()
    server = use().server
    waited: list[int] = []
    assert not hold.close_later(server, lambda: waited.append(-1))  # it is not kept
    taken = use()
    hold.keep(taken.server)
    for number in range(3):
        assert hold.close_later(taken.server, partial(waited.append, number))
        assert waited == list(range(number))
    assert hold.settle()
    assert waited == [0, 1, 2]
    assert not hold.settle()

    def collected() -> None:
        assert hold.close_later(taken.server, partial(waited.append, 4))
        waited.append(3)

    assert hold.close_later(taken.server, collected)
    assert hold.settle()
    assert waited == [0, 1, 2, 3, 4]
    further()
    assert not hold.close_later(taken.server, lambda: waited.append(-1))  # no other is to come
    leave()
