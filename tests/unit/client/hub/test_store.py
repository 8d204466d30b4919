"""The store: complete or absent, read-only, and checked at every use."""

import hashlib
import os
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from envhub_sandbox.errors import SnapshotError, SnapshotIntegrityError
from envhub_sandbox.extras.packages import bounds
from envhub_sandbox.hub import store as store
from envhub_sandbox.hub.listing import FileRecord, HashMismatch, copy_verified, digest_of
from envhub_sandbox.system.folders import cache_root, remove_tree
from tests.hub.stub_hub import git_blob_id

CONTENT = {"env.py": b"print(1)\n", "pkg/deep/data.bin": b"\x00" * 3000, "empty": b""}
COMMIT = "c" * 40


@pytest.fixture
def slot(snapshot_store: Path) -> store.Slot:
    folder = store.repository_folder("https://huggingface.co", "model", "org/repo")
    assert snapshot_store in folder.parents
    return store.Slot(folder, COMMIT, "model/org/repo@ccc")


def records(content: dict[str, bytes] = CONTENT) -> tuple[FileRecord, ...]:
    return tuple(
        FileRecord(path, len(data), f"git-sha1:{git_blob_id(data)}")
        for path, data in sorted(content.items())
    )


def write(record: FileRecord, target: Path) -> None:
    target.write_bytes(CONTENT[record.path])


@pytest.fixture
def published(slot: store.Slot) -> store.Slot:
    store.publish(slot, records(), write, {"revision": "main"})
    return slot


def test_what_just_came_is_whole(published: store.Slot, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere, exists = published.home.with_name("elsewhere"), os.path.lexists
    published.home.rename(elsewhere)

    def appearing(path: Path) -> bool:
        if elsewhere.exists():
            elsewhere.rename(published.home)
        return exists(path)

    monkeypatch.setattr(os.path, "lexists", appearing)
    found = store.load(published)
    assert [one.path for one in found] == sorted(CONTENT)


def test_published_files_load(slot: store.Slot) -> None:
    """What was never stored is absent, not damaged. What went in comes out. The tree holds nothing
    else: the jail is given it, and the hashes that vouch for it are outside."""
    assert store.load(slot) is None
    assert store.commits(slot.folder) == []
    store.publish(slot, records(), write, {"revision": "main"})
    assert store.load(slot) == records()
    files = (path for path in slot.tree.rglob("*") if path.is_file())
    assert {str(path.relative_to(slot.tree)): path.read_bytes() for path in files} == CONTENT
    assert [stored.revision for stored in store.commits(slot.folder)] == ["main"]
    assert slot.record.exists()
    assert slot.tree not in slot.record.parents


@pytest.mark.parametrize("mask", [0o000, 0o077])
def test_every_user_can_only_read_it(snapshot_store: Path, slot: store.Slot, mask: int) -> None:
    before = os.umask(mask)
    try:
        store.publish(slot, records(), write, {})
    finally:
        os.umask(before)
    for path in [slot.tree, *slot.tree.rglob("*")]:
        assert stat.S_IMODE(path.lstat().st_mode) == (0o555 if path.is_dir() else 0o444), path
    above = [path for path in slot.tree.parents if path.is_relative_to(snapshot_store)]
    assert all(stat.S_IMODE(path.stat().st_mode) == 0o755 for path in above)
    assert stat.S_IMODE(slot.record.stat().st_mode) == 0o600


def edit(path: Path, data: bytes) -> None:
    """Change a read-only file and put its times back, as somebody who hides would."""
    times = path.stat()
    path.chmod(0o644)
    path.write_bytes(data)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    path.chmod(0o444)


Damage = Callable[[store.Slot], object]


def writable(change: Damage) -> Damage:
    """A change of the tree, whose folder is made writable for it."""
    return lambda slot: (slot.tree.chmod(0o755), change(slot))


DAMAGE: dict[str, Damage] = {
    "edit": lambda slot: edit(slot.tree / "env.py", b"print(2)\n"),
    "remove": writable(lambda slot: (slot.tree / "empty").unlink()),
    "lose the record": lambda slot: slot.record.unlink(),
}


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (DAMAGE["edit"], r"'env\.py' was changed"),
        (lambda slot: (DAMAGE["edit"](slot), DAMAGE["remove"](slot)), r"'env\.py' was changed"),
        (lambda slot: edit(slot.tree / "env.py", b"print(1)\n#"), r"'env\.py' was changed"),
        (
            writable(lambda slot: (slot.tree / "sitecustomize.py").write_bytes(b"")),
            r"'sitecustomize\.py' is extra",
        ),
        (DAMAGE["remove"], "'empty' is missing"),
        (
            writable(
                lambda slot: (
                    (slot.tree / "env.py").unlink(),
                    (slot.tree / "env.py").symlink_to("/etc/passwd"),
                )
            ),
            r"'env\.py' is not a regular file",
        ),
        (lambda slot: (slot.tree / "pkg").chmod(0o777), "others can write in 'pkg'"),
        (DAMAGE["lose the record"], r"record\.json is missing"),
        (lambda slot: slot.record.write_text('{"format": 1, "files": [[1]]}'), "cannot be read"),
        (lambda slot: slot.record.write_text('{"format": 99, "files": []}'), "cannot be read"),
    ],
    ids=range(10),
)
def test_damage_is_refused_with_a_repair(published: store.Slot, damage: Damage, said: str) -> None:
    """Whatever was changed, nothing is returned, and the error's command makes room again. What was
    changed is not taken for half deleted, either: somebody shall look at it."""
    damage(published)
    if "changed" in said:
        for use in (store.load_whole, lambda slot: store.publish(slot, records(), write, {})):
            with pytest.raises(SnapshotIntegrityError, match=said):
                use(published)
    with pytest.raises(SnapshotIntegrityError, match=said) as caught:
        store.load(published)
    command = str(caught.value).rpartition("downloads it again: ")[2]
    subprocess.run(command, shell=True, check=True)
    assert store.load(published) is None
    store.publish(published, records(), write, {})
    assert store.load(published) == records()


@pytest.mark.parametrize(
    "damage",
    [
        *(DAMAGE["remove"], DAMAGE["lose the record"], lambda slot: remove_tree(slot.tree)),
        lambda slot: (remove_tree(slot.home), slot.home.mkdir()),
    ],
    ids=["a file", "the record", "the tree", "all but the name"],
)
def test_what_is_half_deleted_is_made_again(published: store.Slot, damage: Damage) -> None:
    """By whoever has its source; a jail that has the rest of it open keeps that for a day."""
    damage(published)
    assert store.load_whole(published) is None
    with pytest.raises(store.HalfDeletedError):
        store.load(published)
    store.publish(published, records(), write, {"revision": "main"})
    assert store.load(published) == records()
    [remains] = published.folder.glob(".building-*")
    assert [one.commit for one in store.commits(published.folder)] == [COMMIT]  # none of these
    os.utime(remains, (0, 0))
    store.publish(published, records(), write, {"revision": "main"})
    assert not list(published.folder.glob(".building-*"))


def test_equal_file_is_hashed_once(published: store.Slot, monkeypatch: pytest.MonkeyPatch) -> None:
    os.utime(published.tree / "env.py")
    hashed: list[str] = []

    def counting(path: Path, kind: str, size: int) -> str:
        hashed.append(path.name)
        return digest_of(path, kind, size)

    monkeypatch.setattr(store, "digest_of", counting)
    assert store.load(published) == records()
    assert store.load(published) == records()
    assert hashed == ["env.py"]


def test_copied_store_is_verified_by_content(
    published: store.Slot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "envhub-cache"
    subprocess.run(["cp", "-r", str(source), str(tmp_path / "moved")], check=True)
    folder = tmp_path / "moved" / published.folder.relative_to(source)
    moved = store.Slot(folder, COMMIT, published.title)
    assert store.load(moved) == records()


def test_failing_copy_leaves_nothing(slot: store.Slot) -> None:
    def fail(record: FileRecord, target: Path) -> None:
        write(record, target)
        if record.path == "env.py":
            raise SnapshotIntegrityError("planted")

    with pytest.raises(SnapshotIntegrityError, match="planted"):
        store.publish(slot, records(), fail, {})
    assert list(slot.folder.iterdir()) == []
    assert store.load(slot) is None


def test_killed_builder_leaves_nothing_that_is_believed(slot: store.Slot) -> None:
    code = (
        "import os, sys; from pathlib import Path\n"
        "from tests.unit.client.hub import test_store as t\n"
        "def die(record, target):\n"
        "    t.write(record, target)\n"
        "    if record.path == 'env.py': os.kill(os.getpid(), 9)\n"
        "slot = t.store.Slot(Path(sys.argv[1]), t.COMMIT, 'x')\n"
        "t.store.publish(slot, t.records(), die, {})\n"
    )
    root = Path(__file__).parents[4]
    done = subprocess.run([sys.executable, "-c", code, str(slot.folder)], cwd=root, check=False)
    assert done.returncode == -9
    (left,) = slot.folder.iterdir()
    assert store.load(slot) is None
    store.publish(slot, records(), write, {})
    assert store.load(slot) == records()
    assert left.exists()  # It might have been somebody who is still at work.
    os.utime(left, (time.time() - 10**6,) * 2)
    store.publish(store.Slot(slot.folder, "d" * 40, "x"), records(), write, {})
    assert not left.exists()


def test_second_builder_keeps_the_first_ones_copy(published: store.Slot) -> None:
    inode = (published.tree / "env.py").stat().st_ino
    store.publish(published, records(), write, {})
    assert (published.tree / "env.py").stat().st_ino == inode
    assert [path.name for path in published.folder.iterdir()] == [COMMIT]


def test_a_failing_store_says_where(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path / "file" / "cache"))
    slot = store.Slot(store.folder_of("local"), COMMIT, "x")
    with pytest.raises(SnapshotError, match="set ENVHUB_CACHE to another folder"):
        store.publish(slot, records(), write, {})


def test_store_is_in_the_users_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ENVHUB_CACHE", "~/x")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_root() == tmp_path / "x"
    monkeypatch.delenv("ENVHUB_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_root() == tmp_path / "xdg" / "envhub-sandbox"


def test_endpoints_types_and_names_have_places_of_their_own(snapshot_store: Path) -> None:
    keys = [
        ("https://huggingface.co", "model", "a/b"),
        ("https://huggingface.co", "space", "a/b"),
        ("https://huggingface.co:8443", "model", "a/b"),
        ("http://huggingface.co", "model", "a/b"),
        ("https://huggingface.co/mirror", "model", "a/b"),
        ("https://huggingface.co", "model", "a-b/c"),
        ("https://huggingface.co", "model", "a/b-c"),
        ("https://git.example", "git", "a--b/c"),
        ("https://git.example", "git", "a/b--c"),
        ("https://git.example", "git", "a/b/c"),
        ("https://git.example", "git", "a-/b"),
        ("https://git.example", "git", "a/-b"),
        ("https://git.example", "git", "a/" * 99 + "b"),
        ("https://git.example", "git", "a/" * 99 + "c"),
    ]
    folders = {store.repository_folder(*key) for key in keys}
    assert len(folders) == len(keys)
    assert all(folder.parents[2] == snapshot_store for folder in folders)
    assert all(len(folder.name) < 256 for folder in folders)


def test_unused_snapshots_are_removed(published: store.Slot) -> None:
    other = store.Slot(published.folder, "d" * 40, "x")
    store.publish(other, records(), write, {})
    for slot in (published, other):
        os.utime(slot.record, (time.time() - 10**6,) * 2)
    store.mark_used(other)
    store.remove_unused(published.folder, days=7)
    assert store.load(published) is None
    assert store.load(other) == records()


def test_a_tree_of_any_depth_is_walked_and_removed(tmp_path: Path) -> None:
    """A wheel may have as many folders in one another as a path has room for."""
    top = tmp_path / "top"
    deepest = str(top)
    for _ in range(1200):
        os.mkdir(deepest)
        deepest += "/d"
    Path(deepest).write_bytes(b"12345")
    outside = tmp_path / "outside"
    outside.mkdir()
    (top / "link").symlink_to(outside)
    assert len(list(bounds.walk(top))) == 1201
    top.chmod(0o555)
    remove_tree(top)
    assert not top.exists()
    assert outside.exists()


@pytest.mark.parametrize("kind", ["git-sha1", "sha256"])
def test_copy_is_what_the_record_says_or_an_error(tmp_path: Path, kind: str) -> None:
    source = tmp_path / "source"
    data = os.urandom(2_500_000)
    source.write_bytes(data)
    record = FileRecord("x", len(data), digest_of(source, kind, len(data)))
    known = git_blob_id(data) if kind == "git-sha1" else hashlib.sha256(data).hexdigest()
    assert record.digest == f"{kind}:{known}"
    copy_verified(source, tmp_path / "good", record)
    assert (tmp_path / "good").read_bytes() == data
    flipped = bytes([data[0] ^ 1]) + data[1:]
    for number, other in enumerate([data * 2, data[:-1], flipped]):
        source.write_bytes(other)
        with pytest.raises(HashMismatch):
            copy_verified(source, tmp_path / str(number), record)
        assert (tmp_path / str(number)).stat().st_size <= len(data) + 1, "it copied what it refuses"
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(HashMismatch, match="not a regular file"):
        copy_verified(tmp_path / "pipe", tmp_path / "x", record)
