"""What is waited for later: once, by whoever comes next."""

from __future__ import annotations

from envhub_sandbox.session.jails.partings import Partings


def test_each_is_waited_for_once_by_the_next_or_at_the_end() -> None:
    """Never more than one is left."""
    waited: list[int] = []
    partings = Partings()
    for number in range(3):
        partings.add(lambda number=number: waited.append(number))
        assert waited == list(range(number))
    assert partings.settle()
    assert waited == [0, 1, 2]
    assert not partings.settle()


def test_one_may_be_added_in_the_midst() -> None:
    """The garbage collector closes when it likes."""
    waited: list[str] = []
    partings = Partings()
    partings.add(lambda: (partings.add(lambda: waited.append("inner")), waited.append("outer")))
    assert partings.settle()
    assert waited == ["outer", "inner"]
