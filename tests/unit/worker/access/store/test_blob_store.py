"""The files of one key: what they are charged is what lies there, and is given back."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from envhub_worker.extras.access.store.blob_store import BLOCK_BYTES, BlobStore, ListedFile
from envhub_worker.supervisor.records import RefusedError


def arrived(store: BlobStore, path: str, data: bytes) -> ListedFile:
    digest = hashlib.sha256(data).digest()
    part = store.home / "part"
    part.write_bytes(data)
    store.take(part, digest, len(data))
    return ListedFile(path, len(data), digest)


@pytest.fixture
def store(tmp_path: Path) -> BlobStore:
    return BlobStore(tmp_path)


def test_a_tree_that_cannot_be_finished_leaves_nothing(store: BlobStore) -> None:
    file = arrived(store, "env.py", b"1")
    with pytest.raises(RefusedError):
        store.lay_out("ab", [ListedFile("env.py", 2, file.sha256)], lambda size: None)
    assert list((store.home / "trees").iterdir()) == []
    assert store.held == BLOCK_BYTES
