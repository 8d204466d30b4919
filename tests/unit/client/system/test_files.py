"""Files that are whole, or not there."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from envhub_sandbox.system.files import write_whole_file


def test_a_file_is_replaced_and_nothing_stays_beside_it(tmp_path: Path) -> None:
    """With its mode, less what the umask takes."""
    path = tmp_path / "file"
    for data in (b"one", b"two"):
        write_whole_file(path, data, durable=data == b"two")
        assert path.read_bytes() == data
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert os.listdir(tmp_path) == ["file"]


def test_what_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    """And no half of the new one."""
    path = tmp_path / "file"
    path.mkdir()
    with pytest.raises(OSError, match="director"):
        write_whole_file(path, b"new")
    assert os.listdir(tmp_path) == ["file"]
