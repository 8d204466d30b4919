"""What a client on another host may have, and how much of it; who is busy says so."""

import logging
import threading
from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import PolicyError, ServerBusyError, WorkerError
from envhub_sandbox.extras.remote.sandbox import RemoteSandbox
from envhub_sandbox.extras.remote.sandbox import check_policy as check_place
from envhub_sandbox.settings.policy import Policy
from envhub_worker.extras.access import keys
from envhub_worker.extras.access.quotas import (
    BusyError,
    InFlight,
    Permissions,
    Quotas,
    RefusedError,
    check_jail,
    check_policy,
    use_of,
)
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import Confinement, Limits
from envhub_worker.protocol.runtime import Runtime
from envhub_worker.server.sessions import MAX_HELD, Sessions
from envhub_worker.supervisor.records import Asker
from tests.remote.listening import Listening, listening
from tests.remote.peers import peer
from tests.support.processes import eventually
from tests.support.samples import sample
from tests.support.started import started


def order(python: str = "", **policy: Any) -> tuple[m.OpenJail, Confinement]:
    confinement = Confinement(**policy)
    return m.OpenJail("x", python, "", "sha256:0", "env.py", asdict(confinement), 1), confinement


@pytest.mark.parametrize(
    ("asked", "permitted"),
    [
        ({"python": "/usr/bin/python3"}, None),
        ({"readable": ("/etc",)}, None),
        ({"network": "host"}, {"network": True}),
        ({"gpu": True}, {"gpu": True}),
        ({"gpu": (0,)}, {"gpu": True}),
        ({"profile": "no-userns"}, {"weakest_profile": "no-userns"}),
        ({"profile": "container"}, {"weakest_profile": "container"}),
    ],
)
def test_a_policy_needs_the_operators_permission(
    asked: dict[str, Any], permitted: dict[str, Any] | None
) -> None:
    with pytest.raises(RefusedError) as caught:
        check_policy(*order(**asked), Permissions())
    assert caught.value.error == "PolicyError"
    if permitted is not None:
        check_policy(*order(**asked), Permissions(**permitted))


def test_packages_of_the_repositorys_own_are_not_for_other_hosts() -> None:
    """A folder there cannot be named, however it is asked for; the text says what to do."""
    asked, confinement = order()
    wanted = m.replace(asked, packages="/packages")
    with pytest.raises(RefusedError, match="folders of the remote server") as caught:
        check_policy(wanted, confinement, Permissions())
    assert caught.value.error == "PolicyError"
    with pytest.raises(PolicyError, match="--dependencies"):
        check_place(Policy(), Runtime("", "/packages"))


def test_the_sums_of_a_key_are_bounded() -> None:
    """Jails, runners and each limit that a client sets, of all that is open and the new one."""
    quotas = Quotas(jails=2, runners=4, memory_bytes=100)
    small = use_of(Limits(memory_bytes=40), 2)
    check_jail([small], use_of(Limits(memory_bytes=60), 2), quotas)
    for uses, more, what in (
        ([small, small], use_of(Limits(memory_bytes=1), 1), "jails"),
        ([small], use_of(Limits(memory_bytes=1), 3), "runners"),
        ([small, small], {"runners": 1}, "runners"),
        ([small], use_of(Limits(memory_bytes=61), 1), "memory"),
    ):
        with pytest.raises(BusyError, match=what) as caught:
            check_jail(uses, more, quotas)
        assert caught.value.missing == what


BOUNDED_OTHERWISE = {"cpu_time_s", "file_bytes", "output_bytes", "message_bytes", "elements"}


@pytest.mark.parametrize("name", sorted({f.name for f in fields(Limits)} - BOUNDED_OTHERWISE))
def test_every_limit_that_a_client_sets_stands_under_a_quota(name: str) -> None:
    """What it sets for one jail, and what it has set for others before; its option is said."""
    quotas = replace(Quotas(), **{name: 100})
    check_jail([], {name: 100}, quotas)
    option = f"--max-{name.removesuffix('_bytes').replace('_', '-')}"
    with pytest.raises(RefusedError, match=option):
        check_jail([], use_of(replace(Limits(), **{name: 101}), 1), quotas)
    lower = use_of(replace(Limits(), **{name: 60}), 1)
    with pytest.raises(BusyError, match=option):
        check_jail([lower], lower, quotas)


def test_bytes_in_flight_are_bounded_until_they_are_answered() -> None:
    """Of one key; another's are its own. An id that is used again hides none of them: neither the
    second request nor the answer to it makes the first one forgotten."""
    flying = InFlight()
    first, again = Asker(b"one", 1), Asker(b"one", 1)
    flying.add(b"a", first, 60, 100)
    flying.add(b"b", Asker(b"two", 1), 60, 100)
    with pytest.raises(RefusedError, match="not answered yet"):
        flying.add(b"a", Asker(b"one", 2), 60, 100)
    with pytest.raises(RefusedError, match="with this id"):
        flying.add(b"a", again, 1, 100)
    flying.answered(again)
    with pytest.raises(RefusedError, match="60 bytes"):
        flying.add(b"a", Asker(b"one", 2), 60, 100)
    flying.answered(first)
    flying.answered(first)
    flying.add(b"a", again, 100, 100)


def test_a_session_belongs_to_its_key() -> None:
    """The same name or the same routing id under another key is another session."""
    sessions = Sessions()
    mine = sessions.connect(b"id", b"a" * 32, b"name")
    theirs = sessions.connect(b"id", b"b" * 32, b"name")
    assert mine.owner != theirs.owner
    assert sessions.find(b"id", b"a" * 32) is mine
    assert sessions.find(b"id", b"c" * 32) is None


def test_jails_that_nobody_holds_are_found() -> None:
    """Held once is held until it is no longer listed for as long as it takes; what a client says
    that it holds is bounded."""
    now = [0.0]
    sessions = Sessions(lambda: now[0])
    session = sessions.connect(b"id", b"", b"name")
    for start in range(0, 3 * MAX_HELD, 4096):  # it may list what it likes: the latest count
        sessions.keep(session, tuple(range(start, start + 4096)))
    assert len(session.held) == MAX_HELD
    assert 3 * MAX_HELD - 1 in session.held
    session = sessions.connect(b"another", b"", b"another name")
    assert not sessions.unheld(session, 1, 5)
    sessions.keep(session, (1, 2))
    now[0] = 4
    sessions.keep(session, (2,))
    assert not sessions.unheld(session, 3, 5)
    now[0] = 6
    assert sessions.unheld(session, 1, 5)
    assert not sessions.unheld(session, 2, 5)
    assert not sessions.unheld(session, 3, 5)
    now[0] = 10
    assert sessions.unheld(session, 3, 5)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"python": "/usr/bin/python3"}, "python="),
        ({"policy": {"readable": ("/etc",)}}, "readable"),
    ],
)
def test_this_machines_paths_are_refused_before_anything_is_sent(
    server: Listening, repository: Path, options: dict[str, Any], what: str
) -> None:
    with pytest.raises(PolicyError, match=what):
        make_env(repository, sandbox=server.sandbox(), **options)


def test_what_was_started_ahead_makes_room_under_a_quota(tmp_path: Path) -> None:
    """A task that somebody uses comes first; where there is no room nothing is started ahead."""
    options: dict[str, Any] = {"env_kwargs": {"tasks": 4}, "policy": {"prewarm": 1}}
    with listening(tmp_path / "server", "--max-jails", "2") as server:
        with make_env(sample("many_tasks"), sandbox=server.sandbox(), **options) as suites:
            envs = [env for tasks in suites.values() for env in tasks.values()]
            envs[0].reset(seed=0)

            def comes_to(number: int, state: str) -> bool:
                return eventually(lambda: envs[number].sandbox.stats()["state"] == state)

            assert comes_to(1, "READY")
            envs[3].reset(seed=0)  # would be the third jail
            # its place is free before the thread is done that gave it up
            assert comes_to(1, "IDLE")
            with pytest.raises(WorkerError, match="3 jails"):
                envs[1].reset(seed=0)
            envs[3].close()
            envs[1].reset(seed=0)
            for env in (envs[0], envs[1]):
                env.step(np.zeros(1, int))
            assert comes_to(2, "IDLE")
        assert eventually(lambda: server.jails() == 0)


@pytest.fixture(scope="module")
def narrow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    with listening(tmp_path_factory.mktemp("narrow"), "--max-jails", "1") as server:
        yield server


def test_a_full_server_says_which_quota_and_how_much(narrow: Listening, repository: Path) -> None:
    """As attributes, also after ``retry_s``; what would never fit is another error, for which no
    waiting helps."""
    with started(repository, sandbox=narrow.sandbox()) as first:
        with pytest.raises(ServerBusyError, match=r"2 jails .* \(--max-jails\)") as caught:
            make_env(repository, n_envs=2, sandbox=narrow.sandbox())
        said = caught.value
        assert (said.quota, said.used, said.limit) == ("jails", 1, 1)
        assert said.retry_s > 0
        with pytest.raises(ServerBusyError):
            make_env(repository, n_envs=4, sandbox=narrow.sandbox(retry_s=1.5))
        assert first.step(np.array([0]))[0].tolist() == [[1.0]]
    policy = {"limits": {"memory_bytes": 1 << 50}}
    with pytest.raises(WorkerError) as never:
        make_env(repository, n_envs=3, sandbox=narrow.sandbox(retry_s=60.0), policy=policy)
    assert type(never.value) is WorkerError


def test_who_waits_gets_the_place_once_it_is_free(
    narrow: Listening, repository: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With a notice, for a new repository and for a known one; nothing else has changed."""
    sandbox = narrow.sandbox(retry_s=300.0)
    for seed in (1, 2):
        first = make_env(repository, sandbox=narrow.sandbox())
        first.env.reset(seed=seed)
        made = list[Any]()

        def make(into: list[Any] = made) -> None:
            suites = make_env(repository, n_envs=3, sandbox=sandbox)
            suites.env.reset(seed=1)
            into.append(suites)

        caplog.clear()
        with caplog.at_level(logging.WARNING, "envhub_sandbox.worker"):
            waiting = threading.Thread(target=make)
            waiting.start()
            assert eventually(lambda: "waiting for up to" in caplog.text)
            assert not made
            assert first.env.step(np.array([0]))[0].tolist() == [[1.0]]
            first.close()
            waiting.join(120)
        assert made[0].env.step(np.zeros(3, int))[0].tolist() == [[1.0]] * 3
        made[0].close()


def test_a_session_is_waited_for_like_a_jail(tmp_path: Path) -> None:
    """The refusal names that quota; who asks again is let in once the other has gone."""
    with listening(tmp_path / "server", "--max-sessions", "1") as server:
        pair = keys.load(server.state / "client.key")
        with peer(server, pair) as waiting:
            with peer(server, pair) as first:
                assert isinstance(first.ask(m.Hello(m.VERSION, b"first")), m.Welcome)
                refused = waiting.refused(m.Hello(m.VERSION, b"waiting"))
                assert (refused.error, refused.missing) == ("ServerBusyError", "sessions")
                assert refused.busy.used == 1
            hello = m.Hello(m.VERSION, b"waiting")
            assert eventually(lambda: isinstance(waiting.ask(hello), m.Welcome))


@pytest.mark.parametrize("retry_s", [-1.0, float("inf"), float("nan")])
def test_a_wait_without_end_is_refused(retry_s: float) -> None:
    with pytest.raises(PolicyError, match="retry_s"):
        RemoteSandbox("tcp://127.0.0.1:5555", retry_s=retry_s)
