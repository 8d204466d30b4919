"""Where numpy's threads are set, and where they cannot be."""

import ctypes

import numpy as np
import pytest

from envhub_worker.spawn import blas


def unreadable(path: str) -> None:
    raise OSError(f"{path}: cannot open shared object file: Permission denied")


def test_a_library_that_may_not_be_read_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A zygote that died of it would hide what the loader says: which folder nobody may read."""
    assert np.ones(1).sum() == 1  # its library is loaded here
    monkeypatch.setattr(ctypes, "CDLL", unreadable)
    assert blas.find_setter() is None
