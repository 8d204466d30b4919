"""``envhub cache`` and ``envhub inspect --download``."""

import json
import os
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import psutil
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.cli.cache import stored_snapshots
from envhub_sandbox.extras.packages import environments
from envhub_sandbox.hub import snapshot
from envhub_sandbox.system.folders import cache_root
from envhub_sandbox.system.locks import SharedLock
from envhub_worker.protocol.runtime import RECORD
from tests.faults.remains.traces import temporary_root
from tests.support.command_line import COMMAND, document, envhub
from tests.support.packages.wheels import Index, make_wheel
from tests.support.repositories import write_repository
from tests.support.samples import sample


@pytest.fixture
def stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A store with three local snapshots, the last one used most recently; their commits."""
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path / "cache"))
    commits = []
    for age, name in enumerate("cba"):
        folder = write_repository(tmp_path / name, f"NAME = {name!r}\n")
        found = snapshot.local(folder)
        used = time.time() - 86400 * (2 - age)
        os.utime(found.root.parent / "record.json", (used, used))
        commits.append(found.commit)
    return commits[::-1]


def test_list_shows_what_is_stored(stored: list[str]) -> None:
    found = document("cache", "list")
    folders = [str(cache_root().parent / name) for name in "abc"]
    facts = [(one["commit"], one["bytes"], one["folder"]) for one in found["snapshots"]]
    assert facts == [*zip(stored, [len("NAME = 'a'\n")] * 3, folders, strict=True)]
    assert found["folder"] == str(cache_root())
    rows = [line.split()[:2] for line in envhub("cache", "list").stdout.splitlines()[1:4]]
    assert rows == [[name, commit[:18]] for name, commit in zip(folders, stored, strict=True)]
    envhub("cache", "remove", folders[0], code=0)
    assert [one.commit for one in stored_snapshots()] == stored[1:]


def test_wheels_that_were_built_here_are_listed_and_removed(stored: list[str]) -> None:
    """By their package, or with what was not used for so long; nothing else goes with one."""
    for number, name in enumerate(("one-wheel", "other")):
        home = cache_root() / "wheels" / f"source{number}" / "environment"
        home.mkdir(parents=True)
        make_wheel(home, name)
        (home / "built.json").write_text("{}")
    os.utime(home / "built.json", (1e9, 1e9))
    names = ["one_wheel-1.0-py3-none-any.whl", "other-1.0-py3-none-any.whl"]
    assert [one["file"] for one in document("cache", "list")["wheels"]] == names
    assert all(name in envhub("cache", "list").stdout for name in names)
    for words in (["one-wheel"], ["--unused-for", "30"]):
        told = envhub("cache", "remove", *words).stderr
        assert "Removed 0 snapshots, 0 environments, 1 wheel, " in told
    assert (list((cache_root() / "wheels").iterdir()), len(stored_snapshots())) == ([], 3)


def test_hub_repositories_are_named_as_they_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the prefix of their type; folders that are no snapshots are left alone."""
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path))
    host = tmp_path / "snapshots" / "huggingface.co-12345678"
    for kind, name in (
        *(("model", "org/a"), ("space", "org/b"), ("dataset", "org/c")),
        *(("git", "org/d"), ("pypi", "x@1.0#Y-v0")),
    ):
        home = host / f"{kind}--x" / ("f" * 40)
        home.mkdir(parents=True)
        files = [["env.py", 7, "d", 0, 0, 0]]
        origin = {"endpoint": "https://h", "repo_type": kind, "repo_id": name}
        record = {"format": 1, **origin, "revision": "main", "files": files}
        (home / "record.json").write_text(json.dumps(record))
    broken = host / "model--org--d" / ("e" * 40)
    broken.mkdir(parents=True)
    (broken / "record.json").write_text("[")
    assert {one.repository for one in stored_snapshots()} == {
        *("org/a", "spaces/org/b", "datasets/org/c", "git+https://h/org/d", "pypi:x@1.0#Y-v0")
    }


@pytest.mark.parametrize(("what", "left"), [("its commit", [0, 2]), ("its age", [0, 1])])
def test_remove_takes_only_what_is_meant(stored: list[str], what: str, left: list[int]) -> None:
    """By the beginning of a commit, or unused for so many days."""
    words = [stored[1][:20]] if what == "its commit" else ["--unused-for", "1.5"]
    assert "Removed 1 snapshot" in envhub("cache", "remove", *words, code=0).stderr
    assert [one.commit for one in stored_snapshots()] == [stored[index] for index in left]


def test_a_snapshot_that_is_used_is_kept(stored: list[str], tmp_path: Path) -> None:
    """It is named with its user, and what its code imports later is still there."""
    env = "import gymnasium\n\ndef make_env(n_envs=1, use_async_envs=False):\n"
    env += "    import later\n    return gymnasium.make_vec('CartPole-v1', num_envs=n_envs)\n"
    folder = write_repository(tmp_path / "used", env, later__py="")
    assert (cache_root() / "manifests").is_dir() is False
    with make_env(folder) as suites:
        assert (cache_root() / "manifests").is_dir()
        told = envhub("cache", "remove", "--all", code=0).stderr
        assert "Removed 3 snapshots" in told
        assert f"process {os.getpid()} (" in told
        assert not (cache_root() / "manifests").exists(), "descriptions are forgotten, too"
        suites.env.reset(seed=0)
    assert [one.commit for one in stored_snapshots()] == [suites.provenance["commit"]]


def test_remove_of_an_unknown_name_is_usage(stored: list[str]) -> None:
    assert "nobody/knows" in envhub("cache", "remove", stored[0], "nobody/knows", code=2).stderr
    assert len(stored_snapshots()) == 3


@pytest.fixture
def environment(index: Index, tmp_path: Path) -> str:
    """A repository whose packages have been made ready by the command; its environment's name."""
    make_wheel(index.folder, "wanted")
    folder = write_repository(tmp_path / "repo", "X = 1\n", requirements__txt="wanted\n")
    made = document("inspect", "--download", folder)["environment"]
    assert "wanted==1.0" in made["packages"]
    assert Path(made["folder"], "packages/wanted/__init__.py").is_file()
    return Path(made["folder"]).name


def test_environments_of_packages_come_and_go(
    index: Index, environment: str, tmp_path: Path
) -> None:
    """They are listed. One in use is kept: named, that is an error which says by whom; among
    others, a line. Newer versions are chosen if asked, and the next ``make_env`` has them, too.
    They are removed by name, and those not used; what was left half-made goes as well."""
    [found] = document("cache", "list")["environments"]
    assert (found["name"], found["bytes"] > 0) == (environment, True)
    assert "wanted==1.0" in found["packages"]
    done = envhub("cache", "list")
    assert environment[:12] in done.stdout
    assert "1 snapshot, 1 environment" in done.stderr

    lock = SharedLock(environments.root() / environment / RECORD)
    named = envhub("cache", "remove", environment[:9], code=2)
    swept = envhub("cache", "remove", "--unused-for", "0", code=0)
    assert "0 environments" in swept.stderr
    for told in (named, swept):
        user = f"{environment[:12]} is in use by process {os.getpid()}"
        assert user in " ".join(told.stderr.split())
    assert len(environments.every()) == 1
    lock.release()

    make_wheel(index.folder, "wanted", "2.0")
    asked = ("inspect", "--download", tmp_path / "repo")
    assert Path(document(*asked)["environment"]["folder"]).name == environment
    assert "wanted==2.0" in document(*asked, "--upgrade")["environment"]["packages"]

    half = environments.root() / ".building-0-x"
    half.mkdir()
    used = time.time() - 86400 * 3
    for record in environments.root().glob(f"[!.]*/{RECORD}"):
        os.utime(record, (used, used))
    assert "0 environments" in envhub("cache", "remove", "--unused-for", "4").stderr
    assert "1 environment" in envhub("cache", "remove", environment[:9]).stderr
    assert (len(environments.every()), half.exists()) == (1, False)


def test_a_repository_that_needs_nothing_is_only_downloaded(tmp_path: Path) -> None:
    folder = write_repository(tmp_path / "repo", "X = 1\n", requirements__txt="numpy\n")
    done = envhub("inspect", "--download", folder, code=0)
    assert str(folder) in done.stdout
    assert "this interpreter" in done.stderr
    envhub("inspect", "--download", folder, "--dependencies", "{", code=2)


# --- ``envhub cache gc``, as a user runs it


def gc(
    temporary: Path, *options: str, check: bool = True, before: Sequence[str] = ()
) -> subprocess.CompletedProcess[str]:
    """Run it with a folder for temporary files of its own, and without an engine."""
    variables = {"TMPDIR": str(temporary), "PATH": str(temporary)}
    return subprocess.run(
        [*before, *COMMAND, "cache", "gc", *options],
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=check,
    )


def left_behind(temporary: Path) -> Path:
    folder = temporary / "envhub-docker-abcd0123"
    folder.mkdir(mode=0o700)
    (folder / "alive").touch()  # whose lock no process holds
    return folder


def test_a_running_client_is_left_alone_in_every_namespace() -> None:
    """Its pid and its start time are other ones there; its lock is the same."""
    unshare = shutil.which("unshare")
    assert unshare is not None
    user = [] if os.geteuid() == 0 else ["--map-root-user"]
    apart = ["--time", "--boottime", "5000", "--pid", "--mount-proc", "--fork"]
    with temporary_root() as place:
        suites = make_env(sample("counter"), timeouts={"server_idle_s": 0})
        suites.env.reset(seed=1)
        mine = set(place.glob("envhub-*"))
        assert mine
        dead = left_behind(place)  # not before: a client that starts removes it
        done = gc(place, "--dry-run", "--json", before=[unshare, *user, *apart])
        found = {one["name"] for one in json.loads(done.stdout)["found"]}
        assert str(dead) in found
        assert not found & set(map(str, mine))
        servers = [one.pid for one in psutil.Process().children() if one.status() != "zombie"]
        assert not [name for name in found for pid in servers if f"_{pid}_" in name]
        suites.close()


def test_what_was_left_behind_is_removed(tmp_path: Path) -> None:
    """And said to be; the next run finds nothing. A dry run only names it."""
    folder = left_behind(tmp_path)
    assert f"found        folder {folder}" in gc(tmp_path, "--dry-run").stdout
    assert folder.exists()
    said = json.loads(gc(tmp_path, "--json").stdout)
    assert {"kind": "folder", "name": str(folder), "removed": True} in said["found"]
    assert not folder.exists()
    again = json.loads(gc(tmp_path, "--json").stdout)
    assert [one for one in again["found"] if one["kind"] == "folder"] == []


def test_an_engine_that_is_down_is_said_to_be_so(tmp_path: Path) -> None:
    """Nobody knows its containers; what else was left behind is removed all the same."""
    folder, program = left_behind(tmp_path), tmp_path / "docker"
    program.write_text('#!/bin/sh\necho "{\\"ServerVersion\\": \\"28\\"}"; [ $1 != ps ]\n')
    program.chmod(0o755)
    done = gc(tmp_path, check=False)
    assert done.returncode == 9
    assert "docker could not be asked, so its containers are not known" in done.stderr
    assert not folder.exists()
    again = gc(tmp_path, "--json", check=False)
    assert (again.returncode, set(json.loads(again.stdout)["unasked"])) == (9, {"docker"})
