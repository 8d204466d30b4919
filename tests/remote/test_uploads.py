"""Snapshots that clients bring along: only missing files, verified, bounded, nobody else's."""

import errno
import hashlib
import os
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from envhub_sandbox.extras.remote import repository as remote_repository
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.extras.access.quotas import Quotas
from envhub_worker.extras.access.store.blob_store import BLOCK_BYTES
from envhub_worker.extras.access.store.uploads import MAX_PIECE_BYTES, PREFIX, Uploads
from envhub_worker.protocol import messages as m
from envhub_worker.supervisor.records import RefusedError
from tests.remote.listening import Listening, counting
from tests.support import inside
from tests.support.started import started

ALICE, BOB = b"a" * 32, b"b" * 32
OWNER = ALICE + b"session"
SIX = 6 * BLOCK_BYTES


def sha256(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()


def offer(*files: tuple[str, bytes]) -> m.OfferSnapshot:
    return m.OfferSnapshot(tuple((name, len(data), sha256(data)) for name, data in files))


def refused(match: str) -> Any:
    return pytest.raises(RefusedError, match=match)


def put(uploads: Uploads, data: bytes, *, key: bytes = ALICE, told: bytes | None = None) -> None:
    """Bring one file, in pieces of four bytes."""
    name = sha256(data if told is None else told)
    for at in range(0, max(1, len(data)), 4):
        uploads.put(key + b"session", key, m.PutBlob(name, at), data[at : at + 4])


def bring(uploads: Uploads, *files: tuple[str, bytes], key: bytes = ALICE) -> str:
    """Bring a whole snapshot; returns its name."""
    wanted = uploads.offer(key + b"session", key, offer(*files), ())
    for _, data in files:
        if sha256(data) in wanted.hashes:
            put(uploads, data, key=key)
    wanted = uploads.offer(key + b"session", key, offer(*files), ())
    assert wanted.hashes == ()
    return wanted.snapshot


@pytest.fixture
def uploads(tmp_path: Path) -> Uploads:
    return Uploads(tmp_path / "store", Quotas(upload_bytes=10 * BLOCK_BYTES, upload_files=5))


def brought(uploads: Uploads) -> int:
    """Bytes on disk, whole files and halves."""
    return sum(path.stat().st_size for path in uploads.folder.rglob("*") if path.is_file())


def test_a_snapshot_is_a_real_read_only_tree(uploads: Uploads) -> None:
    """What was brought lies there, empty files and folders included, and nobody may write."""
    name = bring(uploads, ("env.py", b"import x"), ("a/b/empty", b""), ("a/same", b"import x"))
    tree = Path(uploads.tree(ALICE, name))
    assert (tree / "env.py").read_bytes() == (tree / "a/same").read_bytes() == b"import x"
    assert (tree / "a/b/empty").read_bytes() == b""
    for path in [tree, *tree.rglob("*")]:
        assert not path.is_symlink()
        assert not path.stat().st_mode & 0o222
    home = tree.parents[1]
    for path in (uploads.folder, home, *home.iterdir()):
        assert not path.stat().st_mode & 0o066, "another user of the machine can find it"


def test_bytes_with_another_hash_are_refused(uploads: Uploads) -> None:
    asked = offer(("env.py", b"honest"))
    uploads.offer(OWNER, ALICE, asked, ())
    with refused("another hash"):
        put(uploads, b"forged", told=b"honest")
    assert uploads.offer(OWNER, ALICE, asked, ()).hashes
    assert brought(uploads) == 0


def test_what_was_not_asked_for_is_refused(uploads: Uploads) -> None:
    """Not asked for, out of order, longer than it was said to be, or than one piece may be."""
    with refused("not asked for"):
        put(uploads, b"unasked")
    uploads.offer(OWNER, ALICE, offer(("a", b"12345678")), ())
    for why, at, piece in (
        *(("out of order", 4, b"5678"), ("larger", 0, b"123456789")),
        ("too large", 0, bytes(MAX_PIECE_BYTES + 1)),
    ):
        with refused(why):
            uploads.put(OWNER, ALICE, m.PutBlob(sha256(b"12345678"), at), piece)


def test_few_files_are_begun_at_once(uploads: Uploads, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each that is begun is a file on disk and a running hash."""
    monkeypatch.setattr(f"{Uploads.__module__}.MAX_PARTIAL", 1)
    uploads.offer(OWNER, ALICE, offer(("a", b"12345"), ("b", b"54321")), ())
    uploads.put(OWNER, ALICE, m.PutBlob(sha256(b"12345"), 0), b"1234")
    with refused("being uploaded already"):
        uploads.put(OWNER, ALICE, m.PutBlob(sha256(b"54321"), 0), b"5432")


def test_another_clients_files_cannot_be_had_by_their_hash(uploads: Uploads) -> None:
    """Whoever knows the hash of a file still has to bring the file."""
    name = bring(uploads, ("secret", b"of alice"))
    with refused("no such snapshot"):
        uploads.tree(BOB, name)
    asked = offer(("secret", b"of alice"))
    assert uploads.offer(BOB + b"session", BOB, asked, ()).hashes
    again = Uploads(uploads.folder, Quotas())  # after a restart the store is found again
    assert (Path(again.tree(ALICE, name)).is_dir(), name.startswith(PREFIX)) == (True, True)


@pytest.mark.parametrize("name", ["/etc", "sha256:../../etc", "sha256:", "sha256:" + "0" * 64])
def test_a_snapshot_is_no_path(uploads: Uploads, name: str) -> None:
    with refused("no such snapshot"):
        uploads.tree(ALICE, name)


def test_the_longest_unused_make_room_and_those_in_use_stay(uploads: Uploads) -> None:
    """A quota is of what lies there; what a jail runs is never removed under it."""
    first = uploads.tree(ALICE, bring(uploads, ("env.py", b"1" * SIX)))
    os.utime(first, (1, 1))
    with refused("--max-upload"):
        uploads.offer(OWNER, ALICE, offer(("env.py", b"2" * SIX)), {first})
    assert uploads.used_bytes(ALICE) == SIX + BLOCK_BYTES  # nothing is kept for what was refused
    bring(uploads, ("env.py", b"2" * SIX))
    assert not Path(first).exists()
    assert uploads.used_bytes(ALICE) == SIX + BLOCK_BYTES


def test_what_a_client_had_begun_goes_with_it(uploads: Uploads) -> None:
    uploads.offer(OWNER, ALICE, offer(("a", b"12345678")), ())
    uploads.put(OWNER, ALICE, m.PutBlob(sha256(b"12345678"), 0), b"1234")
    assert (brought(uploads), uploads.used_bytes(ALICE)) == (4, 2 * BLOCK_BYTES)
    uploads.forget(OWNER)
    assert brought(uploads) == uploads.used_bytes(ALICE) == 0


def test_an_upload_that_begins_again_is_not_refused_for_its_own_bytes(uploads: Uploads) -> None:
    """What it had brought of its files is gone from the disk, and does not count twice."""
    for content in (b"1", b"1", b"2"):
        data = content * SIX
        uploads.offer(OWNER, ALICE, offer(("a", data)), ())
        assert brought(uploads) == 0
        uploads.put(OWNER, ALICE, m.PutBlob(sha256(data), 0), data[:-1])
        assert uploads.used_bytes(ALICE) == SIX + BLOCK_BYTES
    bring(uploads, ("a", data))
    assert uploads.used_bytes(ALICE) == SIX + BLOCK_BYTES


def test_what_another_session_still_expects_is_not_removed(uploads: Uploads) -> None:
    """Its files lie there unlinked until its snapshot is whole; room is made of others."""
    other = ALICE + b"other"
    old = uploads.tree(ALICE, bring(uploads, ("old", b"0" * BLOCK_BYTES)))
    wanted = uploads.offer(other, ALICE, offer(("one", b"1"), ("two", b"2")), ())
    uploads.put(other, ALICE, m.PutBlob(sha256(b"1"), 0), b"1")
    uploads.offer(OWNER, ALICE, offer(("env.py", b"3" * (SIX - BLOCK_BYTES))), ())
    assert not Path(old).exists()
    uploads.put(other, ALICE, m.PutBlob(sha256(b"2"), 0), b"2")
    whole = uploads.offer(other, ALICE, offer(("one", b"1"), ("two", b"2")), ())
    assert (whole.snapshot, whole.hashes) == (wanted.snapshot, ())


def test_many_sessions_of_a_key_share_its_quota(uploads: Uploads) -> None:
    uploads.offer(ALICE + b"1", ALICE, offer(("a", b"1" * SIX)), ())
    uploads.offer(BOB + b"1", BOB, offer(("a", b"1" * SIX)), ())
    with refused("--max-upload"):
        uploads.offer(ALICE + b"2", ALICE, offer(("a", b"2" * SIX)), ())
    uploads.forget(ALICE + b"1")
    uploads.offer(ALICE + b"2", ALICE, offer(("a", b"2" * SIX)), ())


def test_small_files_and_folders_are_charged_what_they_take(uploads: Uploads) -> None:
    name = bring(uploads, ("a/b/c", b"1"), ("a/b/d", b"1"), ("a/e", b""))
    assert uploads.used_bytes(ALICE) == (2 + 5) * BLOCK_BYTES
    assert Uploads(uploads.folder, Quotas()).used_bytes(ALICE) == (2 + 5) * BLOCK_BYTES
    with refused("--max-upload"):
        deep = offer(("/".join("abcdefghij"), b"1"))
        uploads.offer(OWNER, ALICE, deep, {uploads.tree(ALICE, name)})


def test_copies_are_charged(uploads: Uploads, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system may have no more links: then the same file over and over is no bargain."""
    files = [(name, b"1" * 2 * BLOCK_BYTES) for name in "abcd"]
    monkeypatch.setattr("os.link", Mock(side_effect=OSError(errno.EMLINK, "too many links")))
    with refused("--max-upload"):
        bring(uploads, *files)
    assert brought(uploads) == 2 * BLOCK_BYTES
    tree = Path(uploads.tree(ALICE, bring(uploads, *files[:2])))
    assert [path.stat().st_mode & 0o777 for path in tree.iterdir()] == [0o444] * 2
    assert uploads.used_bytes(ALICE) == (2 + 2 + 2 * 2) * BLOCK_BYTES
    assert Uploads(uploads.folder, Quotas()).used_bytes(ALICE) == uploads.used_bytes(ALICE)


def test_a_program_is_a_copy_that_may_be_run(uploads: Uploads) -> None:
    """A link would be the file that other snapshots have; another snapshot it is, by its name."""
    plain = bring(uploads, ("run.sh", b"x"))
    before = uploads.used_bytes(ALICE)
    row = (*offer(("run.sh", b"x")).files[0], True)
    found = uploads.offer(OWNER, ALICE, m.OfferSnapshot((row,)), ())
    assert (found.hashes, found.snapshot != plain) == ((), True)
    trees = [Path(uploads.tree(ALICE, name)) for name in (plain, found.snapshot)]
    assert [(tree / "run.sh").stat().st_mode & 0o777 for tree in trees] == [0o444, 0o555]
    assert uploads.used_bytes(ALICE) - before > BLOCK_BYTES
    for wrong in (False, 1, "True", (True, True)):
        with refused(r"a file is \(path, size, sha256\[, True\]\)"):
            uploads.offer(OWNER, ALICE, m.OfferSnapshot(((*row[:3], wrong),)), ())


def test_snapshots_and_folders_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The longest unused go; paths of too many steps are refused before any is made."""
    monkeypatch.setattr("envhub_worker.extras.access.store.uploads.MAX_TREES", 2)
    uploads = Uploads(tmp_path / "store", Quotas())
    first, second = (uploads.tree(ALICE, bring(uploads, (name, b""))) for name in "ab")
    with refused("more than 2"):
        uploads.offer(OWNER, ALICE, offer(("c", b"")), {first, second})
    os.utime(first, (1, 1))
    bring(uploads, ("c", b""))
    assert (Path(first).exists(), Path(second).exists()) == (False, True)
    deep = "/".join(["x"] * 60)
    files = tuple((f"{number}/{deep}", 0, bytes(32)) for number in range(4000))
    with refused("parts of paths"):
        uploads.offer(OWNER, ALICE, m.OfferSnapshot(files), ())


def test_what_is_half_deleted_is_made_again(uploads: Uploads) -> None:
    """Of the files that are there, and of those that come again; the rest goes with a restart."""
    files = ("env.py", b"one"), ("sub/more.py", b"two")
    snapshot = bring(uploads, *files)
    charged, tree = uploads.used_bytes(ALICE), Path(uploads.tree(ALICE, snapshot))
    for folder in (tree, tree / "sub"):
        folder.chmod(0o755)
    (tree / "env.py").unlink()
    assert bring(uploads, *files) == snapshot
    assert (tree / "env.py").read_bytes() == b"one"
    (tree / "sub").chmod(0o755)
    (tree / "sub" / "more.py").unlink()
    (tree / "sub" / "more.py").write_bytes(b"half")
    for blob in uploads.folder.glob("*/blobs/*"):
        blob.unlink()
    assert bring(uploads, *files) == snapshot
    assert (tree / "sub" / "more.py").read_bytes() == b"two"
    assert uploads.used_bytes(ALICE) == charged
    assert len(list(tree.parent.iterdir())) == 3
    Uploads(uploads.folder, Quotas())
    assert list(tree.parent.iterdir()) == [tree]


def test_what_a_server_asks_for_again_travels_once(tmp_path: Path) -> None:
    """It could keep its client at it until the deadline, for ever the same few bytes."""
    (tmp_path / "file").write_bytes(b"x" * 10)
    files = remote_repository.listing(tmp_path)
    wanted = [m.MissingBlobs("sha256:x", (files[0].sha256,) * 1000), m.MissingBlobs("sha256:x", ())]
    client = Mock()
    client.request.side_effect = [(one, []) for one in wanted]
    client.receive.return_value = m.Done(), []
    assert remote_repository.upload(client, tmp_path, files, Deadline(60)) == ("sha256:x", 10)
    assert client.send.call_count == 1


def test_only_the_edited_file_travels_to_a_real_server(server: Listening, tmp_path: Path) -> None:
    """A large file goes once; after an edit of another one it stays where it is."""
    data = os.urandom(3 * remote_repository.PIECE_BYTES + 17)
    repository = counting(tmp_path / "large", files={"weights.bin": data, "empty": b""})
    with started(repository, sandbox=server.sandbox()) as env:
        env.step(np.array([0]))
        remote = inside.server(env)
        client = WorkerConnection(remote.endpoint, remote.process_fd, far=remote.far)
        client.hello(Deadline(60))
        (repository / "empty").write_bytes(b"no more")
        files = remote_repository.listing(repository)
        for bytes_ in (len(b"no more"), 0):
            assert remote_repository.upload(client, repository, files, Deadline(60))[1] == bytes_
        client.close()
