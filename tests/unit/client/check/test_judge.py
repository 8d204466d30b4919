"""What a judgement says of the reference itself."""

from pathlib import Path

import pytest

from envhub_sandbox.extras.judge.judge import is_moving
from envhub_sandbox.hub.listing import Snapshot

_COMMIT = "0123456789" * 4


@pytest.mark.parametrize(
    ("reference", "repo_type", "moves"),
    [
        (f"org/repo@{_COMMIT}", "model", False),
        (f"org/repo@{_COMMIT}:sub/env.py", "space", False),
        ("org/repo", "model", True),
        ("org/repo@main:env.py", "model", True),
        (f"org/{_COMMIT}", "model", True),
        (f"org/repo:{_COMMIT}/env.py", "model", True),
        (f"git+https://example.com/org/repo@{_COMMIT}", "git", False),
        (f"git+https://example.com/org/{_COMMIT}", "git", True),
        ("pypi:name@1.0#A-v1", "pypi", False),
        ("pypi:name#A-v1", "pypi", True),
        ("./repo", "local", False),
    ],
)
def test_only_a_commit_in_its_place_pins(reference: str, repo_type: str, moves: bool) -> None:
    """A repository may be called like its commit, and a folder in it like another."""
    snapshot = Snapshot("org/repo", repo_type, _COMMIT, "env.py", Path(), ())
    assert is_moving(reference, snapshot) is moves
