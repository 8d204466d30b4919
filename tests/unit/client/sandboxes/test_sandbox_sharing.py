"""Servers that several environments share: started once, ended once, counted in between."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass, field

import pytest

from envhub_sandbox.sandboxes import refcount
from envhub_sandbox.sandboxes.refcount import Sharing, Uses
from tests.support.interrupts import before_line


@dataclass(eq=False)
class Server:
    """Remembers what was done with it."""

    runs: bool = True
    ends: list[str] = field(default_factory=list)
    uses: Uses = field(default_factory=Uses)

    def stop(self) -> None:
        """Note it, once: whoever was interrupted asks again."""
        if not self.ends:
            self.ends.append("stopped")


def test_started_for_the_first_and_ended_by_the_last() -> None:
    """However many use it in between; the next one gets a fresh one."""
    sharing: Sharing[Server] = Sharing()
    one, two = sharing.acquire("key", Server), sharing.acquire("key", Server)
    first = one.shared
    assert two.shared is first
    one.release()
    one.release()
    assert not first.ends
    two.release()
    assert first.ends == ["stopped"]
    assert sharing.acquire("key", Server).shared is not first


def test_each_key_has_its_own() -> None:
    """Two keys, two servers."""
    sharing: Sharing[Server] = Sharing()
    assert sharing.acquire(1, Server).shared is not sharing.acquire(2, Server).shared


def test_who_has_a_dead_one_keeps_it_and_others_get_a_fresh_one() -> None:
    """The dead one is ended when its last user gives it back, and the fresh one is not."""
    sharing: Sharing[Server] = Sharing()
    dead = sharing.acquire("key", Server)
    dead.shared.runs = False
    fresh = sharing.acquire("key", Server)
    assert fresh.shared is not dead.shared
    assert (len(dead.shared.uses), len(fresh.shared.uses)) == (1, 1)
    dead.release()
    assert (dead.shared.ends, fresh.shared.ends) == (["stopped"], [])
    assert sharing.acquire("key", Server).shared is fresh.shared


def test_what_does_not_start_is_not_remembered() -> None:
    """The next one tries again."""
    sharing: Sharing[Server] = Sharing()

    def fails() -> Server:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sharing.acquire("key", fails)
    use = sharing.acquire("key", Server)
    assert len(use.shared.uses) == 1


def test_all_are_ended_at_exit() -> None:
    """Whoever uses them; and what is started afterwards is a fresh one."""
    sharing: Sharing[Server] = Sharing()
    uses = [sharing.acquire(key, Server) for key in (1, 2)]
    sharing.stop_all()
    assert [use.shared.ends for use in uses] == [["stopped"]] * 2
    uses[0].release()  # its descriptors may be somebody else's by now
    assert uses[0].shared.ends == ["stopped"]
    assert sharing.acquire(1, Server).shared is not uses[0].shared


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
        os._exit(0 if sharing.acquire("key", Server).shared is not ours.shared else 1)
    done.set()
    thread.join()
    assert os.waitpid(child, 0)[1] == 0


def test_a_fork_gives_nothing_back() -> None:
    """It waits for no lock, not even for one of its own: as it forgets what its parent used."""
    sharing: Sharing[Server] = Sharing()
    ours = [sharing.acquire("key", Server)]
    server = ours[0].shared
    child = os.fork()
    if child == 0:  # pragma: no cover
        held = threading.Event()

        def start() -> Server:
            held.set()
            threading.Event().wait()
            raise AssertionError

        threading.Timer(60, os._exit, [1]).start()  # which ends what hangs
        threading.Thread(target=sharing.acquire, args=("other", start)).start()
        code = 0 if held.wait(50) else 1
        ours[0].release()
        ours.clear()
        os._exit(1 if server.ends else code)
    assert os.waitpid(child, 0)[1] == 0
    assert (len(server.uses), server.ends) == (1, [])


def test_what_nobody_has_any_more_is_given_back() -> None:
    """A Ctrl-C came between the taking and the noting: its own end gives it back, once."""
    sharing: Sharing[Server] = Sharing()
    kept, lost = sharing.acquire("key", Server), sharing.acquire("key", Server)
    server = kept.shared
    assert len(server.uses) == 2
    del lost
    assert (len(server.uses), server.ends) == (1, [])
    del kept
    assert server.ends == ["stopped"]


@pytest.mark.parametrize("then", ["given back again", "forgotten", "another opens"])
def test_an_interrupted_release_is_taken_up_by_the_next(then: str) -> None:
    """Wherever it was interrupted; it is ended once, and never under somebody who uses it."""
    line = 0
    while True:
        sharing: Sharing[Server] = Sharing()
        use = sharing.acquire("key", Server)
        server = use.shared
        came = before_line(refcount.__file__, line, use.release)
        if then == "another opens":
            again = sharing.acquire("key", Server)
            del use
            assert not again.shared.ends
            again.release()
            assert again.shared.ends == ["stopped"]
        elif then == "forgotten":
            del use
        else:
            use.release()
        assert server.ends == ["stopped"]
        if not came:
            break
        line += 1
    assert line > 5
