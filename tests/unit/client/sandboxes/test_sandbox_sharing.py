"""Servers that several environments share: started once, ended once, counted in between."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass, field

import pytest

from envhub_sandbox.sandboxes.refcount import Sharing


@dataclass(eq=False)
class Server:
    """Remembers what was done with it."""

    users: int = 0
    runs: bool = True
    ends: list[str] = field(default_factory=list)

    def stop(self) -> None:
        """Note it."""
        self.ends.append("stopped")


def test_started_for_the_first_and_ended_by_the_last() -> None:
    """However many use it in between; the next one gets a fresh one."""
    sharing: Sharing[Server] = Sharing()
    first = sharing.acquire("key", Server)
    assert sharing.acquire("key", Server) is first
    sharing.release(first)
    assert not first.ends
    sharing.release(first)
    assert first.ends == ["stopped"]
    assert sharing.acquire("key", Server) is not first


def test_each_key_has_its_own() -> None:
    """Two keys, two servers."""
    sharing: Sharing[Server] = Sharing()
    assert sharing.acquire(1, Server) is not sharing.acquire(2, Server)


def test_who_has_a_dead_one_keeps_it_and_others_get_a_fresh_one() -> None:
    """The dead one is ended when its last user gives it back, and the fresh one is not."""
    sharing: Sharing[Server] = Sharing()
    dead = sharing.acquire("key", Server)
    dead.runs = False
    fresh = sharing.acquire("key", Server)
    assert fresh is not dead
    assert (dead.users, fresh.users) == (1, 1)
    sharing.release(dead)
    assert (dead.ends, fresh.ends) == (["stopped"], [])
    assert sharing.acquire("key", Server) is fresh


def test_what_does_not_start_is_not_remembered() -> None:
    """The next one tries again."""
    sharing: Sharing[Server] = Sharing()

    def fails() -> Server:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sharing.acquire("key", fails)
    assert sharing.acquire("key", Server).users == 1


def test_all_are_ended_at_exit() -> None:
    """Whoever uses them; and what is started afterwards is a fresh one."""
    sharing: Sharing[Server] = Sharing()
    servers = [sharing.acquire(key, Server) for key in (1, 2)]
    sharing.stop_all()
    assert [server.ends for server in servers] == [["stopped"]] * 2
    sharing.release(servers[0])  # its descriptors may be somebody else's by now
    assert servers[0].ends == ["stopped"]
    assert sharing.acquire(1, Server) is not servers[0]


def test_a_fork_starts_its_own() -> None:
    """Also if another thread held the lock at that moment."""
    sharing: Sharing[Server] = Sharing()
    ours = sharing.acquire("key", Server)
    held, done = threading.Event(), threading.Event()

    def start() -> Server:
        held.set()
        done.wait(60)
        return Server()

    thread = threading.Thread(target=sharing.acquire, args=("other", start))
    thread.start()
    assert held.wait(60)
    child = os.fork()
    if child == 0:  # pragma: no cover
        os._exit(0 if sharing.acquire("key", Server) is not ours else 1)
    done.set()
    thread.join()
    assert os.waitpid(child, 0)[1] == 0
