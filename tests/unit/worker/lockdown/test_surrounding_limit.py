"""The limit around a server is read where the kernel counts, and each kill is told once."""

from __future__ import annotations

from pathlib import Path

import pytest

from envhub_worker.lockdown.limits.cgroups import SurroundingLimit


@pytest.mark.parametrize("name", ["memory.events", "memory/memory.oom_control"])
def test_each_kill_is_one_death(tmp_path: Path, name: str) -> None:
    """What the kernel had counted before the server came is nobody's; there may be no such file."""
    assert not SurroundingLimit(tmp_path / "nowhere").killed_one()
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("low 0\noom_kill 3\n")
    around = SurroundingLimit(tmp_path)
    assert not around.killed_one()
    path.write_text("low 0\noom_kill 5\n")
    assert [around.killed_one() for _ in range(3)] == [True, True, False]
    around.close()
    around.close()
    assert not around.killed_one()
