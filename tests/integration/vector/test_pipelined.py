"""Several steps on their way over a server give what the same steps give one by one."""

from __future__ import annotations

from pathlib import Path

import pytest

from envhub_sandbox.transport.shared_memory.served_lane import ServedLane
from tests.support import inside
from tests.support.compare import assert_same
from tests.support.objects.pipelines import changing, one_by_one, several_at_once
from tests.support.started import started

pytestmark = pytest.mark.same_for("users")


@pytest.mark.parametrize("lane", ["auto", "frames"])
@pytest.mark.parametrize(("count", "workers", "size"), [(2, 1, 3), (1, 1, 100_000), (3, 2, 3)])
def test_what_comes_is_what_a_step_gives(
    tmp_path: Path, lane: str, count: int, workers: int, size: int
) -> None:
    """Also where infos do not fit, change their columns or are not there, and where one raises;
    back and forth between steps through slabs and steps as messages."""
    folder = changing(tmp_path, size)
    with started(folder, count, lane="auto", num_workers=workers) as env:
        expected = one_by_one(env)
    took: list[bool] = []
    with started(folder, count, lane=lane, num_workers=workers) as env:
        found = inside.session(env).lease.lane
        assert found is not None
        assert isinstance(found, ServedLane) == (lane == "frames")
        results = several_at_once(env, lambda: took.append(found.takes_more))
    assert set(took) == ({True, False} if lane == "frames" and workers == 1 else {False})
    for number, (wanted, came) in enumerate(zip(expected, results, strict=True)):
        assert_same(wanted[0], came[0], f"step {number}")
    # of one worker that has warned where another has raised, with this step's answer or the next
    warned = [sorted(text for _, texts in some for text in texts) for some in (expected, results)]
    assert warned[0] == warned[1]
    assert len(warned[0]) > 10
