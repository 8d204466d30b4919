"""Snapshots that clients bring along: only missing files, verified, bounded, nobody else's."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env, upload
from envhub_sandbox.client import WorkerClient
from envhub_sandbox.deadline import Deadline
from envhub_worker.protocol import messages as m
from envhub_worker.quotas import Quotas, RefusedError
from envhub_worker.uploads import PREFIX, Uploads
from tests.remote.listening import Listening, counting

ALICE, BOB = b"a" * 32, b"b" * 32
OWNER = ALICE + b"session"


def offer(*files: tuple[str, bytes]) -> m.OfferSnapshot:
    """A listing of names and contents."""
    return m.OfferSnapshot(
        tuple((name, len(data), hashlib.sha256(data).digest()) for name, data in files)
    )


def put(uploads: Uploads, data: bytes, *, key: bytes = ALICE, told: bytes | None = None) -> None:
    """Bring one file, in pieces of four bytes."""
    sha256 = hashlib.sha256(data if told is None else told).digest()
    for offset in range(0, max(1, len(data)), 4):
        piece = data[offset : offset + 4]
        uploads.put(key + b"session", key, m.PutBlob(sha256, offset), piece)


def bring(uploads: Uploads, *files: tuple[str, bytes], key: bytes = ALICE) -> str:
    """Bring a whole snapshot; returns its name."""
    wanted = uploads.offer(key + b"session", key, offer(*files), ())
    for _, data in files:
        if hashlib.sha256(data).digest() in wanted.hashes:
            put(uploads, data, key=key)
    wanted = uploads.offer(key + b"session", key, offer(*files), ())
    assert wanted.hashes == ()
    return wanted.snapshot


@pytest.fixture
def uploads(tmp_path: Path) -> Uploads:
    """A store for a hundred bytes of each client."""
    return Uploads(tmp_path / "store", Quotas(upload_bytes=100, upload_files=5))


def test_a_snapshot_is_a_real_read_only_tree(uploads: Uploads) -> None:
    """What was brought lies there, empty files and folders included, and nobody may write."""
    name = bring(uploads, ("env.py", b"import x"), ("a/b/empty", b""), ("a/same", b"import x"))
    tree = Path(uploads.tree(ALICE, name))
    assert (tree / "env.py").read_bytes() == (tree / "a/same").read_bytes() == b"import x"
    assert (tree / "a/b/empty").read_bytes() == b""
    for path in [tree, *tree.rglob("*")]:
        assert not path.is_symlink()
        assert not path.stat().st_mode & 0o222


def test_only_missing_files_travel(uploads: Uploads) -> None:
    """A second snapshot that shares a file is asked for the other one only."""
    bring(uploads, ("env.py", b"one"), ("big", b"shared"))
    wanted = uploads.offer(OWNER, ALICE, offer(("env.py", b"two"), ("big", b"shared")), ())
    assert wanted.hashes == (hashlib.sha256(b"two").digest(),)


@pytest.mark.parametrize(
    "path", ["/etc/passwd", "../up", "a/../b", "a//b", ".", "a/./b", "", "a\\b", "a\nb", "x" * 256]
)
def test_a_path_that_could_leave_the_tree_is_refused(uploads: Uploads, path: str) -> None:
    """The rules of a snapshot's names, held again where they become paths."""
    with pytest.raises(RefusedError, match=r"name|too deep"):
        uploads.offer(OWNER, ALICE, offer((path, b"")), ())


@pytest.mark.parametrize(
    "files",
    [
        (),
        (("a", b""), ("a", b"x")),
        (("a", b""), ("a/b", b"x")),
        tuple((str(number), b"") for number in range(6)),
        (("a", b"x" * 101),),
    ],
    ids=["none", "twice", "file and folder", "too many", "too large"],
)
def test_a_listing_that_breaks_a_rule_is_refused(
    uploads: Uploads, files: tuple[tuple[str, bytes], ...]
) -> None:
    """Before anything is taken."""
    with pytest.raises(RefusedError):
        uploads.offer(OWNER, ALICE, offer(*files), ())


@pytest.mark.parametrize(
    "entry", [("a", 1), ("a", -1, bytes(32)), ("a", 1, b"short"), (1, 1, bytes(32)), "a", None]
)
def test_an_entry_that_is_none_is_refused(uploads: Uploads, entry: Any) -> None:
    """Types and lengths are checked, not believed."""
    with pytest.raises(RefusedError, match="a file is"):
        uploads.offer(OWNER, ALICE, m.OfferSnapshot((entry,)), ())


def test_bytes_with_another_hash_are_refused(uploads: Uploads) -> None:
    """The file is gone again, and still wanted."""
    asked = offer(("env.py", b"honest"))
    uploads.offer(OWNER, ALICE, asked, ())
    with pytest.raises(RefusedError, match="another hash"):
        put(uploads, b"forged", told=b"honest")
    assert uploads.offer(OWNER, ALICE, asked, ()).hashes
    assert uploads.used_bytes(ALICE) == 0


def test_what_was_not_asked_for_is_refused(uploads: Uploads) -> None:
    """Not asked for, out of order, or longer than it was said to be."""
    with pytest.raises(RefusedError, match="not asked for"):
        put(uploads, b"unasked")
    uploads.offer(OWNER, ALICE, offer(("a", b"12345678")), ())
    sha256 = hashlib.sha256(b"12345678").digest()
    with pytest.raises(RefusedError, match="out of order"):
        uploads.put(OWNER, ALICE, m.PutBlob(sha256, 4), b"5678")
    with pytest.raises(RefusedError, match="larger"):
        uploads.put(OWNER, ALICE, m.PutBlob(sha256, 0), b"123456789")


def test_another_clients_files_cannot_be_had_by_their_hash(uploads: Uploads) -> None:
    """Whoever knows the hash of a file still has to bring the file."""
    name = bring(uploads, ("secret", b"of alice"))
    with pytest.raises(RefusedError, match="no such snapshot"):
        uploads.tree(BOB, name)
    asked = offer(("secret", b"of alice"))
    assert uploads.offer(BOB + b"session", BOB, asked, ()).hashes


@pytest.mark.parametrize("name", ["/etc", "sha256:../../etc", "sha256:", "sha256:" + "0" * 64])
def test_a_snapshot_is_no_path(uploads: Uploads, name: str) -> None:
    """Only what was offered has a name."""
    with pytest.raises(RefusedError, match="no such snapshot"):
        uploads.tree(ALICE, name)


def test_the_longest_unused_make_room_and_those_in_use_stay(uploads: Uploads) -> None:
    """A quota is of what lies there; what a jail runs is never removed under it."""
    first = uploads.tree(ALICE, bring(uploads, ("env.py", b"1" * 60)))
    os.utime(first, (1, 1))
    with pytest.raises(RefusedError, match="--max-upload"):
        uploads.offer(OWNER, ALICE, offer(("env.py", b"2" * 60)), {first})
    bring(uploads, ("env.py", b"2" * 60))
    assert not Path(first).exists()
    assert uploads.used_bytes(ALICE) == 60


def test_what_a_client_had_begun_goes_with_it(uploads: Uploads) -> None:
    """Half a file is nobody's."""
    uploads.offer(OWNER, ALICE, offer(("a", b"12345678")), ())
    uploads.put(OWNER, ALICE, m.PutBlob(hashlib.sha256(b"12345678").digest(), 0), b"1234")
    assert uploads.used_bytes(ALICE) == 4
    uploads.forget(OWNER)
    assert uploads.used_bytes(ALICE) == 0


def test_a_restart_keeps_snapshots_and_drops_halves(uploads: Uploads) -> None:
    """The store is found again."""
    name = bring(uploads, ("env.py", b"x"))
    again = Uploads(uploads.folder, Quotas())
    assert Path(again.tree(ALICE, name)).is_dir()
    assert name.startswith(PREFIX)


def test_only_the_edited_file_travels_to_a_real_server(server: Listening, tmp_path: Path) -> None:
    """A large file goes once; after an edit of another one it stays where it is."""
    data = os.urandom(3 * upload.PIECE_BYTES + 17)
    repository = counting(tmp_path / "large", files={"weights.bin": data, "empty": b""})
    with make_env(repository, sandbox=server.sandbox()) as suites:
        suites.env.reset(seed=1)
        suites.env.step(np.array([0]))
        remote = suites.env._remote._loaded.server
        client = WorkerClient(remote.endpoint, remote.process_fd, far=remote.far)
        client.hello(Deadline(30))
        (repository / "empty").write_bytes(b"no more")
        files = upload.listing(repository)
        assert upload.bring(client, repository, files, Deadline(30))[1] == len(b"no more")
        assert upload.bring(client, repository, files, Deadline(30))[1] == 0
        client.close()
