"""Our folders and files: their modes, that they are whole, and whom they are believed."""

import os
import shlex
import stat
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from envhub_sandbox.errors import SnapshotError
from envhub_sandbox.factory.env_factory import ManifestCache
from envhub_sandbox.hub import store as store
from envhub_sandbox.hub.listing import FileRecord
from envhub_sandbox.system import folders
from envhub_sandbox.system.folders import write_whole_file
from tests.hub.stub_hub import git_blob_id
from tests.support import inside

COMMIT = "c" * 40
GOOD = b"print(1)\n"
UMASKS = [0o000, 0o077]
needs_root = pytest.mark.skipif(os.getuid() != 0, reason="needs root, who can be another user")
SOMEBODY = 12345


@contextmanager
def umask(mask: int) -> Iterator[None]:
    before = os.umask(mask)
    try:
        yield
    finally:
        os.umask(before)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


@pytest.mark.parametrize("mask", UMASKS)
def test_modes_do_not_follow_the_umask(tmp_path: Path, mask: int) -> None:
    """A shared folder is 0755 and a private one 0700, with every folder above it 0755. Manifests
    are nobody else's: neither the folder nor what is in it."""
    with umask(mask):
        folders.make(tmp_path / "a" / "b")
        folders.make_private(tmp_path / "c" / "d")
        folders.write_private(tmp_path / "c" / "file", b"x")
        ManifestCache(tmp_path / "cache" / "manifests", "key").save({})
    assert [mode(tmp_path / name) for name in ("a", "a/b", "c", "cache")] == [0o755] * 4
    assert [mode(tmp_path / name) for name in ("c/d", "cache/manifests")] == [0o700] * 2
    assert [mode(tmp_path / name) for name in ("c/file", "cache/manifests/key")] == [0o600] * 2


def test_nobody_gets_in_before_the_mode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before: list[int] = []
    monkeypatch.setattr(os, "chmod", lambda path, _: before.append(mode(Path(path))))
    with umask(0):
        folders.make(tmp_path / "a" / "b")
    assert before == [0o700] * 2


def test_folder_that_is_there_keeps_its_mode_unless_it_is_private(tmp_path: Path) -> None:
    """What the user made stays as it is; what is ours alone is closed again."""
    (tmp_path / "his").mkdir()
    (tmp_path / "his").chmod(0o750)
    folders.make(tmp_path / "his" / "ours")
    assert mode(tmp_path / "his") == 0o750
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    folders.make_private(tmp_path / "open")
    assert mode(tmp_path / "open") == 0o700


@pytest.fixture
def slot(snapshot_store: Path) -> store.Slot:
    made = store.Slot(store.folder_of("local"), COMMIT, "model/org/repo@ccc")
    _publish(made, GOOD)
    return made


def _publish(slot: store.Slot, content: bytes) -> None:
    record = FileRecord("env.py", len(content), f"git-sha1:{git_blob_id(content)}")
    store.publish(slot, (record,), lambda _, target: target.write_bytes(content) and None, {})


def _above(path: Path) -> list[Path]:
    return [path.parent, path, path / "snapshots", path / "snapshots" / "local"]


@pytest.mark.parametrize("which", range(4))
@pytest.mark.parametrize("bits", [0o770, 0o777])
def test_folder_that_others_can_write_is_named_and_mended(
    snapshot_store: Path, slot: store.Slot, which: int, bits: int
) -> None:
    """Every folder down to the snapshot counts, its group too; the error's command mends it."""
    wrong = _above(snapshot_store)[which]
    wrong.chmod(bits)
    if which == 0 and bits != 0o777 and inside.is_own_group(wrong):
        assert store.load(slot) is not None  # above the store a plain user's own group may write
        return
    other = store.Slot(slot.folder, "d" * 40, "x")
    for use in (store.load, lambda _: _publish(other, GOOD)):
        with pytest.raises(SnapshotError, match="ENVHUB_CACHE") as caught:
            use(slot)
        assert str(wrong) in str(caught.value)
        assert f"{bits:04o}" in str(caught.value)
    command = f"chmod go-w {shlex.quote(str(wrong))}"
    assert command in str(caught.value)
    subprocess.run(command, shell=True, check=True)
    assert store.load(slot) is not None


@pytest.mark.parametrize(
    ("why", "user", "members", "group_of_another", "access_lists"),
    [
        ("", 1000, ["me"], 8, []),
        ("root", 0, ["me"], 8, []),
        ("a member", 1000, ["me", "another"], 8, []),
        ("another user of that group", 1000, [], 7, []),
        ("an access list", 1000, [], 8, ["system.posix_acl_access"]),
    ],
)
def test_a_users_own_group_has_nobody_else(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    why: str,
    user: int,
    members: list[str],
    group_of_another: int,
    access_lists: list[str],
) -> None:
    """Above the store it may write, as many systems set homes up; any other may not."""
    me = SimpleNamespace(pw_name="me", pw_uid=user, pw_gid=7)
    another = SimpleNamespace(pw_name="another", pw_uid=1001, pw_gid=group_of_another)
    group = SimpleNamespace(gr_name="mine", gr_gid=7, gr_mem=members)
    monkeypatch.setattr("pwd.getpwuid", lambda _: me)
    monkeypatch.setattr("pwd.getpwall", lambda: [me, another])
    monkeypatch.setattr("grp.getgrgid", lambda _: group)
    monkeypatch.setattr("os.listxattr", lambda _: access_lists)
    monkeypatch.setattr(folders, "user_id", lambda: user)
    monkeypatch.setattr(folders, "is_trusted", lambda _: True)
    ours = tmp_path / "above" / "ours"
    ours.mkdir(parents=True)
    ours.parent.chmod(0o770)
    assert bool(folders.why_distrusted(ours, ours)) == bool(why)


def test_sticky_folder_above_the_store_is_no_reason(snapshot_store: Path, slot: store.Slot) -> None:
    """In one like /tmp only we can move what is ours; as the store itself it will not do."""
    snapshot_store.parent.chmod(0o1777)
    assert store.load(slot) is not None
    snapshot_store.chmod(0o1777)
    with pytest.raises(SnapshotError, match="1777"):
        store.load(slot)
    snapshot_store.chmod(0o755)
    (slot.tree / "env.py").chmod(0o666)
    assert store.load(slot) is not None, "a file that others can write is hashed once more"
    assert mode(slot.tree / "env.py") == 0o444


def test_links_are_followed_step_by_step(
    tmp_path: Path, snapshot_store: Path, slot: store.Slot, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "open" / "x").mkdir(parents=True)
    (tmp_path / "open" / "store").symlink_to(f"../{snapshot_store.name}/.")
    (tmp_path / "link").symlink_to(tmp_path / "open" / "x" / ".." / "store")
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path / "link"))
    behind = store.Slot(store.folder_of("local"), COMMIT, "x")
    assert store.load(behind) is not None
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(SnapshotError, match="open can be written by everybody"):
        store.load(behind)
    monkeypatch.setenv("ENVHUB_CACHE", "/dev/null/cache")  # not "chmod go-w /dev/null"
    with pytest.raises(SnapshotError, match="Not a directory"):
        store.load(store.Slot(store.folder_of("local"), COMMIT, "x"))
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(OSError, match="Too many levels"):  # a circle is an error, as for the kernel
        folders.why_distrusted(tmp_path / "a" / "x", tmp_path)


@needs_root
@pytest.mark.parametrize("which", range(7))
def test_root_trusts_no_users_folder(snapshot_store: Path, slot: store.Slot, which: int) -> None:
    """What belongs to somebody else can be changed by him, whoever asks."""
    places = [*_above(snapshot_store), slot.home, slot.record, slot.tree]
    os.chown(places[which], SOMEBODY, -1)
    with pytest.raises(SnapshotError, match=f"belongs to uid {SOMEBODY}") as caught:
        store.load(slot)
    command = f"chown 0 {shlex.quote(str(places[which]))}"
    assert command in str(caught.value)
    subprocess.run(command, shell=True, check=True)
    assert store.load(slot) is not None
    os.chown(slot.tree / "env.py", SOMEBODY, -1)  # he can change it after it was verified
    with pytest.raises(SnapshotError, match=r"'env\.py' belongs to uid"):
        store.load(slot)


@needs_root
def test_somebody_elses_link_is_not_followed(
    tmp_path: Path, snapshot_store: Path, slot: store.Slot, monkeypatch: pytest.MonkeyPatch
) -> None:
    tmp_path.chmod(0o1777)
    (tmp_path / "link").symlink_to(snapshot_store)
    os.chown(tmp_path / "link", SOMEBODY, -1, follow_symlinks=False)
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path / "link"))
    with pytest.raises(SnapshotError, match=r"the link .* belongs to uid"):
        store.load(store.Slot(store.folder_of("local"), COMMIT, "x"))


@needs_root
@pytest.mark.parametrize("way", ["his own", "his group's"])
def test_planted_snapshot_is_refused(
    snapshot_store: Path, slot: store.Slot, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    """Somebody puts a snapshot and a record that vouches for it; unchecked it is believed."""
    place = store.folder_of("local")
    for folder in [snapshot_store, *snapshot_store.parents]:
        if folder.stat().st_mode & 0o001 == 0 and folder.stat().st_uid == 0:
            folder.chmod(folder.stat().st_mode | 0o011)
    os.chown(place, SOMEBODY if way == "his own" else 0, SOMEBODY)
    place.chmod(0o775)
    as_somebody(lambda: os.rename(slot.home, place / ("d" * 40)))
    planted = store.Slot(place, "d" * 40, "x")
    with pytest.raises(SnapshotError, match="not trusted"):
        store.load(planted)
    monkeypatch.setattr(folders, "why_distrusted", lambda *_: "")
    assert store.load(planted) is not None


def as_somebody(act: Callable[[], object]) -> None:
    """Do it in a process of another user; it must work there."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            os.setgroups([])
            os.setresgid(SOMEBODY, SOMEBODY, SOMEBODY)
            os.setresuid(SOMEBODY, SOMEBODY, SOMEBODY)
            act()
            code = 0
        finally:
            os._exit(code)
    assert os.waitpid(pid, 0)[1] == 0


def test_nobody_gets_at_a_snapshot_before_it_is_complete(snapshot_store: Path) -> None:
    made, seen = store.Slot(store.folder_of("local"), COMMIT, "x"), []

    def copy(_: FileRecord, target: Path) -> None:
        target.write_bytes(GOOD)
        seen.append((mode(target), mode(target.parent.parent)))

    record = FileRecord("env.py", len(GOOD), f"git-sha1:{git_blob_id(GOOD)}")
    with umask(0):
        store.publish(made, (record,), copy, {})
    assert seen == [(0o666, 0o700)]


def test_a_file_is_replaced_and_nothing_stays_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "file"
    for data in (b"one", b"two"):
        write_whole_file(path, data)
        assert path.read_bytes() == data
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert os.listdir(tmp_path) == ["file"]
    (tmp_path / "file").unlink()
    path.mkdir()
    with pytest.raises(OSError, match="director"):
        write_whole_file(path, b"new")
    assert os.listdir(tmp_path) == ["file"], "and no half of the new one"


def test_a_text_is_kept_and_recalled(tmp_path: Path) -> None:
    folder = tmp_path / "texts"
    assert folders.recall(folder, "key") is None
    folders.keep(folder, "key", "é")
    assert folders.recall(folder, "key") == "é"
    folder.chmod(0o777)
    assert folders.recall(folder, "key") is None
    folders.keep(folder, "key", "again")
    assert folders.recall(folder, "key") == "again"
    (folder / "key").write_bytes(b"\xff")
    assert folders.recall(folder, "key") is None
    (tmp_path / "file").write_text("")
    folders.keep(tmp_path / "file", "key", "text")  # which is no error: a cache is a favour
    assert (tmp_path / "file").read_text() == ""


def test_no_link_is_followed_when_a_tree_is_removed(tmp_path: Path) -> None:
    tree, elsewhere, link = (tmp_path / name for name in ("tree", "elsewhere", "link"))
    for folder in (tree / "sub", elsewhere):
        folder.mkdir(parents=True)
    (elsewhere / "kept").write_text("")
    for one in (tree / "sub" / "link", link):
        one.symlink_to(elsewhere)
    (tree / "sub").chmod(0o555)
    for path in (tree, link):
        folders.remove_tree(path)
    assert not tree.exists()
    assert (elsewhere / "kept").exists()


def test_a_draft_is_private_and_goes_unless_it_is_moved(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), folders.draft(tmp_path) as made:
        interrupted(made)
    assert list(tmp_path.iterdir()) == []


def interrupted(made: Path) -> None:
    (made / "half").write_text("")
    assert made.stat().st_mode & 0o777 == 0o700
    raise KeyboardInterrupt
