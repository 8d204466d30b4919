"""``env.sandbox`` beside other programs of the caller's: copies, pickles, logs."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from envhub_sandbox.vector.sandbox_view import SandboxView


class Session:
    """One that notes whether a copy of it was begun."""

    repository = SimpleNamespace(label="org/repo")
    begun = False

    def __reduce__(self) -> tuple[Any, ...]:
        self.begun = True
        return Session, ()


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_it_is_not_copied(copied: Callable[[object], object]) -> None:
    """Nor is the session behind it, whose sockets a half-made copy would close."""
    session: Any = Session()
    with pytest.raises(TypeError, match=r"<sandbox of org/repo> .* pickle that environment"):
        copied(SandboxView(session))
    assert not session.begun
