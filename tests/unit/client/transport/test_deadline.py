"""Whether to wait awake is decided by what was measured. Which shard runs on which core."""

import math
import os

import pytest

from envhub_sandbox.transport import deadline as module
from envhub_sandbox.transport.deadline import Cores, Deadline, SpinChooser, StepDeadline, place


def run(chooser: SpinChooser, steps: int, awake_ns: int, asleep_ns: int) -> int:
    """Step with given costs; returns how many steps were waited for awake."""
    awake = 0
    for _ in range(steps):
        spinning = chooser.budget_ns > 0
        awake += spinning
        chooser.measured(awake_ns if spinning else asleep_ns)
    return awake


@pytest.mark.parametrize(
    ("allowed", "awake_ns", "asleep_ns", "least", "most"),
    [
        (True, 10, 20, 9_001, 10_000),  # where it pays, nearly all steps are waited for awake
        (True, 2_000, 20, 0, 299),  # where it costs, it is tried seldom
        (False, 1, 1_000, 0, 0),  # where a core may see stores out of order, the lane sleeps
    ],
)
def test_spinning_is_chosen_where_it_pays(
    allowed: bool, awake_ns: int, asleep_ns: int, least: int, most: int
) -> None:
    assert least <= run(SpinChooser(allowed), 10_000, awake_ns, asleep_ns) <= most


def test_a_change_of_load_is_noticed() -> None:
    chooser = SpinChooser(True)
    run(chooser, 10_000, awake_ns=10, asleep_ns=20)
    run(chooser, 20_000, awake_ns=2_000, asleep_ns=20)
    assert chooser.budget_ns == 0
    run(chooser, 20_000, awake_ns=10, asleep_ns=20)
    assert chooser.budget_ns > 0


def test_waits_in_vain_end_spinning_at_once() -> None:
    """A core that somebody else takes does not cost the rest of a long interval. The budget follows
    what awake steps take: a reply that is long overdue is waited for asleep."""
    chooser = SpinChooser(True)
    run(chooser, 10_000, awake_ns=50_000, asleep_ns=90_000)
    assert chooser.budget_ns == 150_000
    limited = SpinChooser(True, longest_ns=120_000)
    run(limited, 10_000, awake_ns=50_000, asleep_ns=90_000)
    assert limited.budget_ns == 120_000
    for _ in range(3):
        chooser.missed()
        chooser.measured(1_000_000)
    assert chooser.budget_ns == 0


def test_a_slow_step_now_and_then_does_not_end_spinning() -> None:
    """An episode that ends makes one step long; the next is answered in time again."""
    chooser = SpinChooser(True)
    run(chooser, 1_000, awake_ns=10_000, asleep_ns=20_000)
    for _ in range(10):
        chooser.missed()
        chooser.measured(1_000_000)
        run(chooser, 1, awake_ns=10_000, asleep_ns=20_000)
    assert chooser.budget_ns > 0


@pytest.mark.parametrize("client", [0, 1, 2, 3])
@pytest.mark.parametrize("shards", [2, 3, 4, 9])
def test_a_shard_that_waits_awake_is_not_on_the_clients_core(shards: int, client: int) -> None:
    cpus = [0, 1, 2, 3]
    awake = min(shards, len(cpus) - 1)
    placed = [cpu - 1 for cpu in place(shards, awake, client, cpus)]
    assert client not in placed[:awake]
    assert len(set(placed[:awake])) == awake
    assert set(placed) <= set(cpus)


@pytest.mark.parametrize("shards", [1, 2, 3])
def test_one_core_is_the_clients(monkeypatch: pytest.MonkeyPatch, shards: int) -> None:
    """Shards that find no other core sleep: the first of them shares the client's."""
    assert place(4, 1, 0, [0, 1]) == [2, 1, 2, 1]
    assert place(2, 0, 5, [5]) == [6, 6]
    monkeypatch.setattr(module, "own_cpus", lambda: [0, 1])
    assert Cores(shards).awake == 1


@pytest.mark.parametrize("count", [1, 4])
def test_a_program_may_have_fewer_cores_later(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """As a trainer does with each of its processes: an environment uses those that there are."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(count)))
    assert Cores(9).awake == count - 1


# --- Deadlines: asked for what is left, in any unit, for any length


@pytest.mark.parametrize("kind", [Deadline, StepDeadline])
@pytest.mark.parametrize("timeout_s", [None, -5.0, 1e6, 1e30, 1e308, math.inf])
def test_any_deadline_can_be_waited_for(kind: type[Deadline], timeout_s: float | None) -> None:
    """None never comes. What is left is never negative; a wait is at least a millisecond, and even
    infinity has milliseconds that poll() takes: who waits asks again afterwards."""
    deadline = kind(timeout_s)
    assert deadline.passed == (timeout_s == -5.0)
    left_s, left_ms = deadline.left_s(), deadline.left_ms()
    if timeout_s is None:
        assert left_s is left_ms is None
    elif timeout_s < 0:
        assert (left_s, left_ms) == (0.0, 1)
    else:
        assert 0 < left_ms < 2**31


def test_a_steps_deadline_counts_from_its_first_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step has all of its time, and whoever never has to wait never reads the clock."""
    now = [100.0]
    monkeypatch.setattr(module, "monotonic", lambda: now[0])
    deadline = StepDeadline(5.0)
    for _ in range(2):
        deadline.running = False
        now[0] += 60.0
        assert not deadline.passed
        now[0] += 2.0
        assert deadline.left_s() == 3.0
        now[0] += 3.0
        assert deadline.passed
        assert deadline.left_ms() == 1
