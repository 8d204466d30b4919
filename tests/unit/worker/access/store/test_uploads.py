"""What clients bring: of a store that several servers of a machine use, and of one key."""

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest

from envhub_worker.extras.access.quotas import Quotas
from envhub_worker.extras.access.store import blob_store
from envhub_worker.extras.access.store.uploads import Uploads
from envhub_worker.protocol import messages as m
from envhub_worker.supervisor.records import RefusedError

ONE, OTHER = b"1" * 32, b"2" * 32


def brought(uploads: Uploads, key: bytes, data: bytes, *, whole: bool = True) -> m.MissingBlobs:
    """Offer a snapshot of one file and bring it; the first answer. Half of it, if not whole."""
    sha256 = hashlib.sha256(data).digest()
    offer = m.OfferSnapshot((("env.py", len(data), sha256),))
    wanted = uploads.offer(key, key, offer, set())
    if wanted.hashes:
        uploads.put(key, key, m.PutBlob(sha256, 0), data if whole else data[: len(data) // 2])
        if whole:
            assert not uploads.offer(key, key, offer, set()).hashes
    return wanted


def shared(folder: Path, quotas: Quotas | None = None) -> Uploads:
    return Uploads(folder, quotas or Quotas(), shared=True)


def test_what_one_has_brought_is_there_for_all(tmp_path: Path) -> None:
    """Of whatever key; the control is a store that is not shared."""
    first, second = shared(tmp_path / "shared"), shared(tmp_path / "shared")
    assert brought(first, ONE, b"data").hashes
    assert not brought(second, OTHER, b"data").hashes
    alone = Uploads(tmp_path / "alone", Quotas())
    assert brought(alone, ONE, b"data").hashes
    assert brought(alone, OTHER, b"data").hashes


def test_two_may_lay_out_the_same_at_once(tmp_path: Path) -> None:
    first, second = shared(tmp_path), shared(tmp_path)
    data, sha256 = b"data", hashlib.sha256(b"data").digest()
    offer = m.OfferSnapshot((("env.py", len(data), sha256),))
    for one, key in ((first, ONE), (second, OTHER)):
        assert one.offer(key, key, offer, set()).hashes
    for one, key in ((first, ONE), (second, OTHER)):
        one.put(key, key, m.PutBlob(sha256, 0), data)
    digest = first.offer(ONE, ONE, offer, set()).snapshot
    assert second.offer(OTHER, OTHER, offer, set()).snapshot == digest
    assert len(list(tmp_path.glob("shared/trees/*"))) == 1


def test_a_start_leaves_alone_what_others_bring(tmp_path: Path) -> None:
    first = shared(tmp_path)
    brought(first, ONE, b"data", whole=False)
    [part] = tmp_path.glob("*/parts/*")
    second = shared(tmp_path)
    assert part.exists()
    del first, second
    assert shared(tmp_path) is not None
    assert not part.exists()


def test_only_one_that_is_alone_makes_room(tmp_path: Path) -> None:
    quotas = replace(Quotas(), upload_bytes=50_000)
    first, second = shared(tmp_path, quotas), shared(tmp_path, quotas)
    brought(first, ONE, bytes(20_000))
    with pytest.raises(RefusedError, match="--max-upload"):
        brought(first, ONE, b"1" * 30_000)
    del second
    brought(first, ONE, b"1" * 30_000)
    assert len(list(tmp_path.glob("*/trees/*"))) == 1


def test_a_share_is_taken_back_after_a_vain_try(tmp_path: Path) -> None:
    uses = [blob_store.SharedUse(tmp_path / "lock") for _ in range(2)]
    for use, expected in ((uses[0], True), (uses[1], False), (uses[0], False), (uses[1], False)):
        with use.alone() as alone:
            assert alone is expected


def test_a_tree_that_cannot_be_finished_leaves_nothing(tmp_path: Path) -> None:
    store, part = blob_store.BlobStore(tmp_path), tmp_path / "part"
    part.write_bytes(b"1")
    sha256 = hashlib.sha256(b"1").digest()
    store.take(part, sha256, 1)
    with pytest.raises(RefusedError):
        store.lay_out("ab", [blob_store.ListedFile("env.py", 2, sha256)], lambda size: None)
    assert list((tmp_path / "trees").iterdir()) == []
    assert store.held == blob_store.BLOCK_BYTES
