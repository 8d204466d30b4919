"""Servers that nobody uses: kept for their time, handed on, and ended whatever comes."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import pytest

from envhub_sandbox.policy import Policy, timeouts_from
from envhub_sandbox.sandboxes.base import WorkerServer
from envhub_sandbox.sandboxes.docker import sandbox as docker
from envhub_sandbox.sandboxes.docker.engines import Engine
from envhub_sandbox.sandboxes.lingering import Lingering
from envhub_sandbox.sandboxes.refcount import Sharing, Use, Uses
from envhub_sandbox.session.jails.server_hold import ServerHold
from tests.support import inside
from tests.support.processes import eventually


@dataclass(eq=False)
class Server:
    """Remembers what was done with it; its end can be made to last."""

    runs: bool = True
    uses: Uses = field(default_factory=Uses)
    ends: list[str] = field(default_factory=list)
    ending: threading.Event = field(default_factory=threading.Event)
    may_end: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self.may_end.set()

    def stop(self) -> None:
        """Note who ended it."""
        self.ending.set()
        assert self.may_end.wait(60)
        self.runs = False
        self.ends.append(threading.current_thread().name)


def given_up(sharing: Sharing[Server], key: str, idle_s: float | None) -> Server:
    """One that was used once."""
    use = sharing.acquire(key, Server, idle_s)
    use.release()
    return use.shared


@pytest.fixture
def lingering() -> Iterator[Lingering[Server]]:
    """At the end of a test nothing lingers, and nobody waits."""
    made: Lingering[Server] = Lingering()
    yield made
    made.stop_all()
    assert eventually(lambda: not _waiting())


@pytest.fixture
def sharing(lingering: Lingering[Server]) -> Sharing[Server]:
    """What is given up in it lingers, if it is asked to."""
    return Sharing(lingering)


def test_the_next_gets_the_one_that_lingers(sharing: Sharing[Server]) -> None:
    """However often it changes hands; nobody has ended it."""
    first = given_up(sharing, "key", 600)
    for _ in range(100):
        assert given_up(sharing, "key", 600) is first
    assert not first.ends


def test_without_a_time_it_ends_at_once(sharing: Sharing[Server]) -> None:
    """By whoever gives it back, in his own thread."""
    assert given_up(sharing, "key", 0).ends == [threading.current_thread().name]


def test_its_time_comes(sharing: Sharing[Server]) -> None:
    """It is ended once, in the background, and the thread that did it ends, too."""
    server = given_up(sharing, "key", 0.01)
    assert eventually(lambda: server.ends == ["envhub-idle"])
    assert eventually(lambda: not _waiting())
    assert given_up(sharing, "key", 0) is not server


def test_one_lingers_at_most(sharing: Sharing[Server]) -> None:
    """With the next its time has come, however long it was."""
    first, second = given_up(sharing, "one", None), given_up(sharing, "two", None)
    assert eventually(lambda: bool(first.ends))
    assert not second.ends


def test_one_that_has_died_is_not_handed_on(sharing: Sharing[Server]) -> None:
    """The next gets a fresh one, and the dead one is cleaned up after."""
    dead = given_up(sharing, "key", None)
    dead.runs = False
    fresh = given_up(sharing, "key", None)
    assert fresh is not dead
    assert eventually(lambda: len(dead.ends) == 1)


def test_one_that_has_died_in_use_does_not_linger(sharing: Sharing[Server]) -> None:
    """It is ended by the one who gives it back."""
    use = sharing.acquire("key", Server, None)
    use.shared.runs = False
    use.release()
    assert use.shared.ends


def test_who_asks_while_it_ends_gets_a_fresh_one_at_once(sharing: Sharing[Server]) -> None:
    """From the moment on that its time has come it is nobody's, and nobody waits for its end."""
    use = sharing.acquire("key", Server, 0.01)
    old = use.shared
    old.may_end.clear()
    use.release()
    assert old.ending.wait(60)
    fresh = sharing.acquire("key", Server)
    assert fresh.shared is not old
    old.may_end.set()
    assert eventually(lambda: bool(old.ends))
    assert not fresh.shared.ends


def test_taken_or_ended_but_never_both(sharing: Sharing[Server]) -> None:
    """Whoever comes in the moment in which the time comes: nobody has one that was ended."""
    for attempt in range(300):
        given_up(sharing, "key", (attempt % 10) * 1e-4)
        taken = sharing.acquire("key", Server, 1e-4)
        assert taken.shared.runs
        assert not taken.shared.ends
        taken.release()
    assert eventually(lambda: not _waiting())


def test_one_that_has_died_is_ended_by_whoever_asks_next(sharing: Sharing[Server]) -> None:
    """And not when its time has come: until somebody waits for it, it is a zombie."""
    dead = given_up(sharing, "key", 600)
    dead.runs = False
    fresh = sharing.acquire("key", Server)
    assert fresh.shared is not dead
    assert eventually(lambda: bool(dead.ends))
    assert not fresh.shared.ends
    fresh.release()


def test_many_at_once_share_what_lingers(sharing: Sharing[Server]) -> None:
    """Threads that open and close with times around nothing never meet an ended one."""
    wrong: list[Server] = []

    def use() -> None:
        for attempt in range(100):
            taken = sharing.acquire("key", Server, (attempt % 3) * 1e-4)
            if taken.shared.ends:
                wrong.append(taken.shared)
            taken.release()

    threads = [threading.Thread(target=use) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_at_the_end_of_the_process_all_end_and_none_is_kept(
    lingering: Lingering[Server], sharing: Sharing[Server]
) -> None:
    """Those that linger, and what is given up afterwards."""
    idle, used = given_up(sharing, "idle", 600), sharing.acquire("used", Server, 600)
    lingering.stop_all(for_good=True)
    assert idle.ends == [threading.current_thread().name]
    used.release()
    assert used.shared.ends == [threading.current_thread().name]


def test_the_end_waits_for_what_is_ending(
    lingering: Lingering[Server], sharing: Sharing[Server]
) -> None:
    """So that nothing is left half ended."""
    use = sharing.acquire("key", Server, 0.01)
    server = use.shared
    server.may_end.clear()
    use.release()
    assert server.ending.wait(60)
    threading.Timer(0.1, server.may_end.set).start()
    lingering.stop_all()
    assert server.ends == ["envhub-idle"]


def test_a_fork_has_none_and_ends_none(sharing: Sharing[Server]) -> None:
    """Also if another thread was about to end it at that moment."""
    ours = given_up(sharing, "key", 600)
    child = os.fork()
    if child == 0:  # pragma: no cover
        code = 1
        try:
            own = given_up(sharing, "key", 0.01)
            assert own is not ours
            assert eventually(lambda: bool(own.ends))
            assert not ours.ends
            code = 0
        finally:
            os._exit(code)
    assert os.waitpid(child, 0)[1] == 0
    assert sharing.acquire("key", Server).shared is ours


def hold_of(sharing: Sharing[Server]) -> ServerHold:
    """A suite's hold on the servers of a sharing."""

    def nothing() -> None:
        pass

    acquire = partial(sharing.acquire, "key", Server)
    return ServerHold(acquire, nothing, nothing)  # type: ignore[arg-type]


def keep(hold: ServerHold, use: Use[Server]) -> None:
    """A jail is opened in a server."""
    hold.keep(cast("WorkerServer", use.shared))


def test_a_hold_lasts_from_the_first_jail_to_the_last_environment(
    sharing: Sharing[Server],
) -> None:
    """However many jails come and go in between; to leave twice is to leave once."""
    hold = hold_of(sharing)
    leave_one, leave_two = hold.enter(), hold.enter()
    use = sharing.acquire("key", Server)
    server = use.shared
    for _ in range(3):
        keep(hold, use)
    use.release()
    assert len(server.uses) == 1
    leave_one()
    leave_one()
    assert not server.ends
    leave_two()
    assert server.ends
    keep(hold, use)  # nobody is left who could need it
    assert len(server.uses) == 0


def test_a_hold_moves_on_from_a_server_that_has_died(sharing: Sharing[Server]) -> None:
    """It keeps the one that the next jail was opened in."""
    hold = hold_of(sharing)
    leave = hold.enter()
    dead = sharing.acquire("key", Server)
    keep(hold, dead)
    dead.release()
    dead.shared.runs = False
    fresh = sharing.acquire("key", Server)
    keep(hold, fresh)
    assert dead.shared.ends
    assert len(fresh.shared.uses) == 2
    fresh.release()
    leave()
    assert fresh.shared.ends


def test_a_hold_whose_end_was_interrupted_ends_with_the_next_leave(
    sharing: Sharing[Server],
) -> None:
    """A Ctrl-C came while it waited for the jails that were still ending."""
    hold = hold_of(sharing)
    leave = hold.enter()
    use = sharing.acquire("key", Server)
    keep(hold, use)

    def interrupted() -> None:
        raise KeyboardInterrupt

    hold.partings.add(interrupted)
    server = use.shared
    server.stop = interrupted  # type: ignore[method-assign]
    use.live = False  # the hold's is the last
    with pytest.raises(KeyboardInterrupt):
        leave()
    del server.stop
    assert not server.ends
    leave()
    assert server.ends


def test_a_container_changes_hands_only_when_nobody_uses_it(
    monkeypatch: pytest.MonkeyPatch, lingering: Lingering[Server]
) -> None:
    """Its memory is one ``make_env``'s; another policy, or another repository, has its own."""
    monkeypatch.setattr(*inside.IDLE_CONTAINERS, lingering)
    monkeypatch.setattr(*inside.CONTAINER_STARTS, lambda self: Server())
    monkeypatch.setattr(docker, "ContainerServer", Server)
    engine = Engine("docker", "/usr/bin/docker", "1", rootless=False)

    def sandbox(snapshot: str = "/one", **policy: Any) -> docker.RepositoryContainer:
        options, made = docker.DockerSandbox(), Policy(**policy)
        return docker.RepositoryContainer(options, engine, "sha256:0", Path(snapshot), made)

    first, second = sandbox(), sandbox()
    one, two = first.acquire(Path("/"), idle_s=600), second.acquire(Path("/"))
    assert one.shared is not two.shared
    two.release()
    one.release()
    again = sandbox().acquire(Path("/"))
    assert again.shared is one.shared
    other = sandbox().acquire(Path("/"), idle_s=600)
    other.release()
    further = sandbox("/two").acquire(Path("/")), sandbox(network="loopback").acquire(Path("/"))
    assert other.shared not in [use.shared for use in further]
    assert sandbox().acquire(Path("/")).shared is other.shared


def test_the_setting_takes_nothing_and_for_ever() -> None:
    """The only time that may be 0."""
    assert timeouts_from({"server_idle_s": 0}).server_idle_s == 0
    assert timeouts_from({"server_idle_s": None}).server_idle_s is None
    with pytest.raises(ValueError, match="server_idle_s is -1"):
        timeouts_from({"server_idle_s": -1})


def _waiting() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "envhub-idle"]
