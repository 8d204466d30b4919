"""A folder of which nothing remains: what each test here proves at its end."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.faults.remains.clients import is_clean, left
from tests.faults.remains.traces import temporary_root


@pytest.fixture
def folder() -> Iterator[Path]:
    """Where a client's temporary files go; in the end nothing of it is left, wherever that was."""
    with temporary_root() as found:
        yield found
        assert is_clean(found), left(found)
