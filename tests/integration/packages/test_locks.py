"""``make_env(lock=)`` and ``envhub lock [--check]``: what was locked runs, and only that."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import LockDriftError, LockError, PolicyError
from envhub_sandbox.extras.packages.resolution import resolutions
from tests.support.command_line import document, envhub
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import Index, make_wheel
from tests.support.repositories import importing, write_repository

ENV = importing("not_here", version="not_here.VERSION")


@pytest.fixture(scope="module")
def packages(real_index: Index) -> Index:
    """An index with a package that is not installed here."""
    make_wheel(real_index.folder, "not-here", "1.0")
    return real_index


@pytest.fixture
def folder(packages: Index, tmp_path: Path) -> Path:
    return Path(write_repository(tmp_path / "repo", ENV, requirements__txt="not-here\n"))


def lock(folder: Path, *options: str, code: int = 0) -> dict[str, Any]:
    done = envhub("lock", folder, "-o", path_of(folder), "--json", *options, code=code)
    return json.loads(done.stdout) if code == 0 else {"said": done.stdout + done.stderr}


def path_of(folder: Path) -> Path:
    return folder.parent / "pylock.repo.toml"


def verify(folder: Path, *options: str, code: int) -> str:
    done = envhub("lock", "--check", path_of(folder), folder, *options, code=code)
    return " ".join((done.stdout + done.stderr).split())


def test_what_was_locked_runs_whatever_is_newer(packages: Index, folder: Path) -> None:
    """Although the choice was forgotten, and the index has another by now."""
    told = lock(folder)
    assert "not-here==1.0" in told["packages"]
    make_wheel(packages.folder, "not-here", "2.0")
    shutil.rmtree(resolutions.root())
    try:
        with make_env(folder, lock=path_of(folder)) as suites:
            assert suites.env.call("version") == ("1.0",)
            assert "not-here==1.0" in suites.provenance["installed"]["packages"]
        assert "as it was locked" in verify(folder, code=0)
        assert "envhub lock --upgrade" in lock(folder, code=2)["said"]
        changes = lock(folder, "--upgrade", "--no-spaces")["changes"]
        assert changes == ["package not-here: 1.0 was locked, this is 2.0"]
    finally:
        (packages.folder / "not_here-2.0-py3-none-any.whl").unlink()
        shutil.rmtree(resolutions.root())


def test_a_file_that_changed_is_refused(folder: Path) -> None:
    """Before anything is started; by the file's name. So is another Python."""
    lock(folder, "--no-spaces")
    (folder / "env.py").write_text(ENV + "\n# changed\n")
    with pytest.raises(LockDriftError, match=r"file env\.py: other content") as caught:
        make_env(folder, lock=path_of(folder))
    assert str(caught.value).startswith(f"{folder}:env.py: ")
    assert any(line.startswith("commit: local-") for line in caught.value.drifts)
    assert "file env.py: other content" in verify(folder, code=7)
    (folder / "env.py").write_text(ENV)
    text = path_of(folder).read_text()
    path_of(folder).write_text(text.replace('implementation = "cpython"', 'implementation = "x"'))
    with pytest.raises(LockDriftError, match=r"Python: x 3\.\d+ on"):
        make_env(folder, lock=path_of(folder))


def test_spaces_that_changed_are_refused(folder: Path) -> None:
    lock(folder)
    text = path_of(folder).read_text()
    before, _, after = text.partition('spaces = "sha256:')
    path_of(folder).write_text(f'{before}spaces = "sha256:{"0" * 64}{after[64:]}')
    with pytest.raises(LockDriftError, match="environment hub_env/0"):
        make_env(folder, lock=path_of(folder))
    assert "environment hub_env/0" in verify(folder, code=7)
    assert "as it was locked" in verify(folder, "--no-spaces", code=0)
    with make_env(folder, lock=path_of(folder), env_kwargs={"name": "Acrobot-v1"}) as suites:
        assert suites.env.single_action_space.n == 3


def test_a_package_that_was_replaced_is_refused(
    packages: Index, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its version is there, its file is another; nothing of it is kept."""
    lock(folder, "--no-spaces")
    wheel = packages.folder / "not_here-1.0-py3-none-any.whl"
    before = wheel.read_bytes()
    monkeypatch.setenv("UV_CACHE_DIR", str(tmp_path / "empty"))
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path / "cache"))
    make_wheel(packages.folder, "not-here", "1.0", {"not_here/__init__.py": "VERSION = 'evil'\n"})
    try:
        with refused_dependency("integrity", match="not-here"):
            make_env(folder, lock=path_of(folder))
        assert "package not-here==1.0: the file with SHA-256" in verify(folder, code=7)
    finally:
        wheel.write_bytes(before)


def test_other_arguments_say_something_else(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lock(folder, "--no-spaces")
    for other in ({"python": "/usr/bin/python3"}, {"dependencies": "host"}, {"dependencies": {}}):
        with pytest.raises(PolicyError, match="has the packages already"):
            make_env(folder, lock=path_of(folder), **other)
    for place in ("docker", "tcp://host:1", ["process"]):
        with pytest.raises(PolicyError, match="lock is for sandbox='process'"):
            make_env(folder, lock=path_of(folder), sandbox=place)
    with pytest.raises(PolicyError, match="lock"):
        make_env(folder, lock=path_of(folder), sandbox=None, trust_remote_code=True)
    with pytest.raises(LockError, match="envhub lock REF"):
        make_env(folder, lock=folder / "none.toml")
    inside = folder / "pylock.repo.toml"  # it would be one of the files
    told = envhub("lock", folder, "-o", inside, code=2).stderr
    assert "inside the folder that it locks" in " ".join(told.split())
    assert not inside.exists()
    path_of(folder).unlink()
    monkeypatch.chdir(folder)  # beside it, not inside
    envhub("lock", ".", "--no-spaces", code=0)
    assert path_of(folder).exists()


def test_what_a_lock_needs_is_fetched_ahead(packages: Index, folder: Path) -> None:
    lock(folder, "--no-spaces")
    locked = ("--lock", path_of(folder))
    told = document("inspect", "--download", folder, *locked)
    assert "not-here==1.0" in told["environment"]["packages"]
    asked = len(packages.asked)
    document("inspect", folder, *locked)
    assert len(packages.asked) == asked
