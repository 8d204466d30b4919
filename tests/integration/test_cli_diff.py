"""``envhub diff --run``: both are loaded in a sandbox, and their tasks and spaces compared."""

from __future__ import annotations

from pathlib import Path

from tests.integration.test_cli_run import envhub
from tests.support.repositories import CARTPOLES, write_repository


def test_spaces_are_compared_where_that_is_asked_for(tmp_path: Path) -> None:
    """Without ``--run`` nothing is known of them."""
    made = CARTPOLES + "\ndef make_env(n_envs=1, use_async_envs=False):\n    return cartpoles(1)\n"
    old = write_repository(tmp_path / "old", made)
    new = write_repository(tmp_path / "new", made.replace("CartPole-v1", "Acrobot-v1"))
    read = envhub("diff", old, new)
    assert (read.returncode, "Discrete" in read.stdout) == (7, False), read.stderr
    ran = envhub("diff", old, new, "--run")
    assert ran.returncode == 7, ran.stderr
    assert "actions were Discrete(2), now Discrete(3)" in ran.stdout
