"""What is expected where packages are refused."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from envhub_sandbox.errors import DependencyError, DependencyReason


@contextmanager
def refused_dependency(
    reason: DependencyReason, match: str | None = None
) -> Iterator[pytest.ExceptionInfo[DependencyError]]:
    """``pytest.raises`` of a ``DependencyError``, for this reason."""
    with pytest.raises(DependencyError, match=match) as caught:
        yield caught
    assert caught.value.reason == reason
