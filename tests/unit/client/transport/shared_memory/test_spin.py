"""Whether to wait awake is decided by what was measured."""

from __future__ import annotations

from envhub_sandbox.transport.shared_memory.spin import SpinChooser


def run(chooser: SpinChooser, steps: int, awake_ns: int, asleep_ns: int) -> int:
    """Step with given costs; returns how many steps were waited for awake."""
    awake = 0
    for _ in range(steps):
        spinning = chooser.budget_ns > 0
        awake += spinning
        chooser.measured(awake_ns if spinning else asleep_ns)
    return awake


def test_spinning_that_pays_is_chosen() -> None:
    """Where waiting awake is faster, nearly all steps are waited for awake."""
    assert run(SpinChooser(True), 10_000, awake_ns=10, asleep_ns=20) > 9_000


def test_spinning_that_costs_is_given_up() -> None:
    """Where it is slower, it is tried seldom."""
    assert run(SpinChooser(True), 10_000, awake_ns=2_000, asleep_ns=20) < 300


def test_a_change_of_load_is_noticed() -> None:
    """A core that gets busy, or free again, changes the decision."""
    chooser = SpinChooser(True)
    run(chooser, 10_000, awake_ns=10, asleep_ns=20)
    run(chooser, 20_000, awake_ns=2_000, asleep_ns=20)
    assert chooser.budget_ns == 0
    run(chooser, 20_000, awake_ns=10, asleep_ns=20)
    assert chooser.budget_ns > 0


def test_waits_in_vain_end_spinning_at_once() -> None:
    """A core that somebody else takes does not cost the rest of a long interval."""
    chooser = SpinChooser(True)
    run(chooser, 10_000, awake_ns=10_000, asleep_ns=20_000)
    assert chooser.budget_ns > 0
    for _ in range(3):
        chooser.missed()
        chooser.measured(1_000_000)
    assert chooser.budget_ns == 0


def test_the_budget_follows_what_awake_steps_take() -> None:
    """A reply that is long overdue is not waited for awake."""
    chooser = SpinChooser(True)
    run(chooser, 10_000, awake_ns=50_000, asleep_ns=90_000)
    assert chooser.budget_ns == 150_000


def test_a_slow_step_now_and_then_does_not_end_spinning() -> None:
    """An episode that ends makes one step long; the next is answered in time again."""
    chooser = SpinChooser(True)
    run(chooser, 1_000, awake_ns=10_000, asleep_ns=20_000)
    for _ in range(10):
        chooser.missed()
        chooser.measured(1_000_000)
        run(chooser, 1, awake_ns=10_000, asleep_ns=20_000)
    assert chooser.budget_ns > 0


def test_spinning_that_is_not_allowed_never_happens() -> None:
    """Where a core may see stores out of order, the lane sleeps."""
    assert run(SpinChooser(False), 1_000, awake_ns=1, asleep_ns=1_000) == 0
