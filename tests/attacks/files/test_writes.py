"""Changing files that are not the jail's: the snapshot, caches, another jail's, the host's."""

import contextlib
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from envhub_sandbox.hub import snapshot
from envhub_sandbox.system.folders import cache_root
from tests.attacks.harness import (
    HOSTILE,
    USER,
    Arena,
    OpenJail,
    Run,
    call,
    control_run,
    run_in,
    token,
)

FAMILY = "Changing files"


def open_file(path: Path, text: str) -> Path:
    if not path.parent.exists():
        path.parent.mkdir(parents=True)
        path.parent.chmod(0o777)
    path.write_text(text)
    path.chmod(0o666)
    return path


@pytest.mark.short("strict-a file in the home")
@pytest.mark.parametrize(
    ("title", "place"),
    [
        ("a file in the home", ".bashrc"),
        ("the Hub cache", ".cache/huggingface/hub/models--o--r/blobs/1234"),
        ("the Hub token", ".cache/huggingface/token"),
        ("a start-up file of Python", ".local/lib/python3/site-packages/usercustomize.py"),
        ("/dev/shm", "/dev/shm/envhub-attack-{token}"),  # a jail has its own
    ],
)
def test_files_outside_are_not_written(jail: OpenJail, home: Path, title: str, place: str) -> None:
    path = home / place.format(token=token())
    try:
        jail.attack(
            f"write into {title}",
            "write_file",
            lambda run: path.read_text() != "as it was",
            before=lambda: open_file(path, "as it was"),
            path=str(path),
            text="attacked",
        )
    finally:
        path.unlink()


@pytest.mark.short("strict-/tmp")
@pytest.mark.parametrize(
    ("title", "folder"),
    [
        ("/dev/shm", "/dev/shm"),
        ("/tmp", "/tmp"),
        ("the home", "{home}"),
        ("the cache of manifests", "{cache}/manifests"),
        ("the store of snapshots", "{cache}/snapshots/planted"),
    ],
)
def test_no_files_are_created_outside(jail: OpenJail, home: Path, title: str, folder: str) -> None:
    """No new file appears in a folder that everybody may write, nor in our own caches."""
    place = Path(folder.format(home=home, cache=cache_root()))
    ours = not place.exists()
    place.mkdir(parents=True, exist_ok=True)
    path, sticky = place / f"planted-{token()}", place.stat().st_mode & stat.S_ISVTX
    try:
        jail.attack(
            f"create a file in {title}",
            "create_file",
            lambda run: path.exists(),
            before=lambda: path.unlink(missing_ok=True),
            path=str(path),
            text="attacked",
        )
    finally:
        path.unlink(missing_ok=True)
        assert place.stat().st_mode & stat.S_ISVTX == sticky  # the control is no vandal
        if ours:
            place.rmdir()


def stored(folder: Path) -> Path:
    folder.mkdir()
    (folder / "env.py").write_text(f"# {token()}")
    return snapshot.local(str(folder)).root / "env.py"


def test_other_snapshots_cannot_be_written(jail: OpenJail, home: Path) -> None:
    outer, inner = stored(home / "outer"), stored(home / "inner")
    was = {path: path.read_text() for path in (outer, inner)}

    def changed(run: Run) -> bool:
        path = inner if run.inside else outer
        return path.read_text() != was[path]

    jail.attack(
        "write into another repository's snapshot",
        "write_file",
        changed,
        inside={"path": str(inner)},
        path=str(outer),
        text="attacked",
    )


def test_other_snapshots_cannot_be_read(jail: OpenJail, home: Path) -> None:
    path = stored(home / "private")
    jail.steal("read another repository's snapshot", "read_file", path.read_text(), path=str(path))


@pytest.mark.parametrize("payload", ["write_file", "delete_file", "rename_file", "create_file"])
def test_own_snapshot_cannot_be_written(arena: Arena, home: Path, payload: str) -> None:
    """The repository's own files stay what was verified, by every path that leads to them."""
    text = {"text": "attacked"} if payload in ("write_file", "create_file") else {}
    outer = stored(home / "outer").with_name("new.py" if payload == "create_file" else "env.py")
    was = fingerprint(outer.parent)
    with control_run(payload, {"path": str(outer), **text}) as control:
        assert fingerprint(outer.parent) != was, control.text
    tree = snapshot.local(str(HOSTILE)).root
    was = fingerprint(tree)
    with arena.environment() as env:
        run = run_in(env, "where_am_i")
        for folder in (run.value["root"], run.value["cwd"], str(tree)):
            path = f"{folder}/{outer.name}"
            call(env, run, payload, {"path": path, **text})
    through = fingerprint(tree) != was
    arena.judge(f"{payload.replace('_', ' ')}: its own snapshot", "succeeds", through, run.text)


def fingerprint(tree: Path) -> dict[Path, tuple[bytes, int]]:
    return {
        path: (path.read_bytes(), path.stat().st_mode)
        for path in sorted(tree.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize(
    ("title", "payload", "changed"),
    [
        ("delete a file", "delete_file", lambda path: not path.exists()),
        ("move a file", "rename_file", lambda path: not path.exists()),
        ("chmod a file", "change_mode", lambda path: path.stat().st_mode & 0o777 == 0o666),
        ("set a file's times", "change_times", lambda path: path.stat().st_mtime == 1),
        (
            "set an attribute of a file",
            "change_attribute",
            lambda path: path.exists() and "user.attack" in os.listxattr(path),
        ),
    ],
)
def test_files_outside_cannot_be_altered(
    jail: OpenJail, home: Path, title: str, payload: str, changed: Callable[[Path], bool]
) -> None:
    path = home / "file"

    def prepare() -> None:
        open_file(path, "as it was").chmod(0o600)
        os.utime(path)
        with contextlib.suppress(OSError):
            os.removexattr(path, "user.attack")

    jail.attack(
        f"{title} outside", payload, lambda run: changed(path), before=prepare, path=str(path)
    )


def test_owner_of_files_outside_cannot_be_changed(jail: OpenJail, home: Path) -> None:
    """chown leaves a file's group alone; a plain user needs a second group to show it."""
    path = home / "file"
    others = [group for group in os.getgroups() if group != os.getgid()]
    gid = 65533 if USER == "root" else (others or [0])[0]
    jail.attack(
        "chown a file outside",
        "change_owner",
        lambda run: path.stat().st_gid == gid,
        before=lambda: (path.unlink(missing_ok=True), open_file(path, "as it was")),
        path=str(path),
        gid=gid,
        impossible="" if USER == "root" or others else "this user has no second group",
    )


def test_scratch_of_another_jail_is_closed(jail: OpenJail) -> None:
    secret = token()
    with jail.arena.environment() as victim:
        owner = run_in(victim, "plant", text=secret)
        [pid] = owner.pids()
        outer = Path(f"/proc/{pid}/root{owner.value}")
        assert outer.read_text() == secret

        def raided(run: Run) -> bool:
            return secret in run.text or outer.read_text() != secret

        jail.attack(
            "read and write another jail's scratch",
            "raid",
            raided,
            before=lambda: outer.write_text(secret),
            paths=[owner.value, str(outer)],
            text="attacked",
        )
