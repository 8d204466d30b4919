"""The files of one key: what they are charged is what lies there, and is given back."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from envhub_worker.access.store.blob_store import (
    BLOCK_BYTES,
    BlobStore,
    ListedFile,
    blob_charge,
    tree_charge,
)
from envhub_worker.supervisor.records import RefusedError

DATA = {"env.py": b"1", "sub/deep/b.bin": bytes(10_000)}


def arrived(store: BlobStore, path: str, data: bytes) -> ListedFile:
    digest = hashlib.sha256(data).digest()
    part = store.home / "part"
    part.write_bytes(data)
    store.take(part, digest, len(data))
    return ListedFile(path, len(data), digest)


@pytest.fixture
def store(tmp_path: Path) -> BlobStore:
    return BlobStore(tmp_path)


def test_a_tree_is_charged_while_it_lies_there(store: BlobStore) -> None:
    """A block for each entry and for the smallest file; a new start counts the same."""
    files = [arrived(store, path, data) for path, data in DATA.items()]
    assert store.held == blob_charge(1) + blob_charge(10_000) == BLOCK_BYTES + 10_000
    store.lay_out("ab", files, lambda size: None)
    assert store.has_all("ab", files)
    assert store.held == BLOCK_BYTES + 10_000 + tree_charge(DATA)
    assert tree_charge(DATA) == 4 * BLOCK_BYTES
    assert BlobStore(store.home).held == store.held
    assert store.unused([]) == ["ab"]
    assert store.unused([str(store.tree("ab"))]) == []
    store.remove("ab")
    store.remove_unlinked([files[0].sha256])
    assert store.held == BLOCK_BYTES
    assert not store.blob(files[1].sha256).exists()


def test_a_tree_that_cannot_be_finished_leaves_nothing(store: BlobStore) -> None:
    file = arrived(store, "env.py", b"1")
    with pytest.raises(RefusedError):
        store.lay_out("ab", [ListedFile("env.py", 2, file.sha256)], lambda size: None)
    assert list((store.home / "trees").iterdir()) == []
    assert store.held == BLOCK_BYTES


def test_what_somebody_deleted_in_part_gives_its_place_back(store: BlobStore) -> None:
    """It is set aside for the jails that have it open, and the next one is whole."""
    files = [arrived(store, "env.py", b"1")]
    store.lay_out("ab", files, lambda size: None)
    store.tree("ab").chmod(0o755)
    (store.tree("ab") / "env.py").unlink()
    assert not store.has_all("ab", files)
    store.set_aside("ab")
    store.lay_out("ab", files, lambda size: None)
    assert store.has_all("ab", files)
    assert store.held == 2 * BLOCK_BYTES
