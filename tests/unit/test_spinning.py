"""Whether to wait awake is decided by what was measured."""

from __future__ import annotations

from envhub_sandbox.spinning import SpinChooser


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


def test_spinning_that_is_not_allowed_never_happens() -> None:
    """Where a core may see stores out of order, the lane sleeps."""
    assert run(SpinChooser(False), 1_000, awake_ns=1, asleep_ns=1_000) == 0
