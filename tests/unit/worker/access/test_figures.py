"""A server's figures: what clients and their jails use, and that clients make no labels of them."""

import subprocess

import pytest

from envhub_worker.extras.access.audit import figures
from envhub_worker.lockdown.mechanisms import procfs
from tests.support.processes import eventually


def test_what_processes_use_is_added_up_by_client(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "EVERY_S", 3600.0)
    shell = ["sh", "-c", "i=0; while [ $i -lt 200000 ]; do i=$((i+1)); done; cat; :"]
    with subprocess.Popen(shell, stdin=subprocess.PIPE) as process:
        taken = figures.Usage(pytest.fail)
        assert eventually(lambda: len(procfs.descendants(process.pid)) == 1)
        found, again = (figures.look_at(process.pid) for _ in range(2))
        assert again.started == found.started, "it would be taken for another, and counted anew"
        assert (found.pid, found.memory_bytes > 0, found.cpu_s >= 0) == (process.pid, True, True)
        taken.watch({process.pid: "client"})
        taken.look()
        assert set(taken.memory_bytes) == {"client"}
        assert taken.memory_bytes["client"] >= found.memory_bytes // 2
        before = taken.cpu_s["client"]
        assert before > 0
        process.communicate()
    assert figures.look_at(process.pid) is None
    taken.look()
    assert taken.memory_bytes == {}
    assert taken.cpu_s["client"] == before
    taken.close()


def test_what_clients_say_cannot_make_a_label() -> None:
    tally = figures.Tally()
    for number in range(1000):
        tally.asked(f"client {number}", f"operation {number}")
        tally.open(f"client {number}")
        tally.refused(f"Error{number}", f"quota{number}")
    assert len(tally.requests) == figures.MAX_CLIENTS + 1
    assert {word for one in tally.requests.values() for word in one} == {"other"}
    assert tally.requests[figures.OTHERS]["other"] == 1000 - figures.MAX_CLIENTS
    assert tally.refusals == {"other": 1000}
    clients = figures.ClientFigures()
    clients.add_past(tally, figures.Usage(lambda _: None))
    assert len(clients.plain()) <= figures.MAX_CLIENTS + 1
    assert figures.client_name("a\n\x1b[2J" * 100, insecure=False).isprintable()
    assert len(figures.client_name("a" * 1000, insecure=False)) == 64
