"""Lock files: written and read again, held against what is there, and never believed."""

import dataclasses
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envhub_sandbox.errors import EnvHubError, LockDriftError, LockError
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.locks import lockfile, making
from envhub_sandbox.extras.packages.locks.lockfile import LockFile, Runner, Spaces
from envhub_sandbox.extras.packages.locks.making import fingerprint_of_spaces, fingerprint_of_task
from envhub_sandbox.extras.packages.request import AUTO, chosen
from envhub_sandbox.extras.packages.resolution import pylock, resolve, uv
from envhub_sandbox.extras.packages.resolution.pylock import PylockPackage, Wheel
from envhub_sandbox.extras.packages.source import RepositoryPackages
from envhub_sandbox.hub.snapshot import local
from envhub_worker.protocol.manifest.manifest import Manifest
from tests.support import wire
from tests.support.packages.wheels import WORKERS, Index, make_wheel, served

A, B = "a" * 64, "b" * 64
BOX = gym.spaces.Box(-1, 1, (3,), np.float32)
TASK = fingerprint_of_task("suite", 0, "NextStep", BOX, gym.spaces.Discrete(2))
LOCK = LockFile(
    "org/repo",
    "0" * 40,
    "env.py",
    {"env.py": f"sha256:{A}", 'a "b".py': f"git-sha1:{'1' * 40}"},
    Runner("cpython", "3.11", "x86_64"),
    (PylockPackage("one", "1.0", (Wheel(A, "https://index/one-1.0.whl", 7), Wheel(B))),),
    ("scipy>=1.11",),
    "2026-01-31",
    Spaces('{"size": 8}', (TASK,)),
)


def changed(**fields: Any) -> LockFile:
    return dataclasses.replace(LOCK, **fields)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "pylock.repo.toml"
    lockfile.write(LOCK, path)
    assert lockfile.read(path) == LOCK
    full = changed(
        only=("a<2",), override=("b==1",), without=("c",), inferred=("d (env.py, line 1)",)
    )
    full = dataclasses.replace(full, assets=(f"datasets/org/data@{'2' * 40}",))
    lockfile.write(full, path)
    assert lockfile.read(path) == full
    choice = making.again(full)
    assert (list(map(str, choice.only or ())), choice.infer) == (["a<2"], False)
    assert (list(map(str, choice.override)), choice.without) == (["b==1"], ("c",))
    plain = changed(spaces=None, exclude_newer=None, extra=())
    lockfile.write(plain, path)
    assert lockfile.read(path) == plain
    (tmp_path / "other").write_text("")
    assert path.stat().st_mode == (tmp_path / "other").stat().st_mode
    assert [file.name for file in tmp_path.iterdir() if file.name.startswith(".")] == []


def test_a_lock_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    with pytest.raises(LockError, match="cannot be written"):
        lockfile.write(LOCK, tmp_path / "none" / "pylock.repo.toml")
    with pytest.raises(LockError, match="cannot be written"):
        lockfile.write(changed(entry="\udc80.py"), tmp_path / "pylock.repo.toml")
    assert list(tmp_path.iterdir()) == []


PYTHON = interpreters.own().path


def made(folder: Path, *lines: str, **options: Any) -> LockFile:
    folder.mkdir(exist_ok=True)
    (folder / "env.py").write_text("")
    (folder / "requirements.txt").write_text("".join(f"{line}\n" for line in lines))
    return making.locked(local(folder), chosen({}, None)[0], **options)


def test_a_lock_has_every_package_with_its_files(index: Index, tmp_path: Path) -> None:
    """What the repository needs and what the worker imports; uv itself installs from it. A file
    that was replaced on the index is told; a further one for the same version is no drift. What
    was chosen before is locked, until it is chosen again."""
    make_wheel(index.folder, "wanted")
    lock = made(tmp_path / "repo", "wanted")
    assert {one.name: one.version for one in lock.packages} == {**WORKERS, "wanted": "1.0"}
    assert lock.repository == lockfile.LOCAL
    assert set(lock.files) == {"env.py", "requirements.txt"}
    path, target = tmp_path / "pylock.repo.toml", tmp_path / "target"
    lockfile.write(lock, path)
    command = ["pip", "install", "--no-config", "--no-build", "--python", PYTHON]
    command += ["--target", str(target), "-r", str(path)]
    uv.run(command, what="the lock is none", timeout_s=300)
    assert (target / "wanted/__init__.py").is_file()
    make_wheel(index.folder, "wanted", tag="py2.py3-none-any")
    assert making.differences(lock, making.relisted(lock)) == []
    make_wheel(index.folder, "wanted", files={"wanted/__init__.py": "evil = 1\n"})
    [said] = making.differences(lock, making.relisted(lock))
    assert said.startswith("package wanted==1.0: the file with SHA-256 ")
    assert made(tmp_path / "repo", "wanted").packages == lock.packages
    assert making.differences(lock, made(tmp_path / "repo", "wanted", upgrade=True)) == [said]


def test_hashes_of_the_repository_hold_in_its_lock(index: Index, tmp_path: Path) -> None:
    wheel = make_wheel(index.folder, "wanted")
    make_wheel(index.folder, "wanted", files={"wanted/other.py": ""}, tag="py2.py3-none-any")
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    lock = made(tmp_path / "repo", f"wanted==1.0 --hash=sha256:{digest}")
    [wanted] = [package for package in lock.packages if package.name == "wanted"]
    assert [one.sha256 for one in wanted.wheels] == [digest]


def test_upgrading_shows_what_differs(index: Index, tmp_path: Path) -> None:
    make_wheel(index.folder, "wanted", "1.0")
    before = made(tmp_path / "repo", "wanted")
    make_wheel(index.folder, "wanted", "2.0", requires=["its-own"])
    make_wheel(index.folder, "its-own")
    assert made(tmp_path / "repo", "wanted") == before
    after = made(tmp_path / "repo", "wanted", upgrade=True)
    assert making.differences(before, after) == [
        "package its-own: new, 1.0",
        "package wanted: 1.0 was locked, this is 2.0",
    ]


OTHER_BOX = gym.spaces.Box(-1, 2, (3,), np.float32)
OTHER_TASK = fingerprint_of_task("suite", 0, "NextStep", OTHER_BOX, gym.spaces.Discrete(2))


@pytest.mark.parametrize(
    ("now", "said"),
    [
        (changed(repository="org/other"), "repository: org/repo was locked, this is org/other"),
        (changed(commit="1" * 40), f"commit: {'0' * 18} was locked, this is {'1' * 18}"),
        (changed(entry="other.py"), "entry file: env.py was locked, this is other.py"),
        (changed(files={**LOCK.files, "env.py": f"sha256:{B}"}), "file env.py: other content"),
        (changed(files={**LOCK.files, "x\x1b.py": f"sha256:{B}"}), "file x\\x1b.py: new"),
        (changed(files={"env.py": f"sha256:{A}"}), 'file a "b".py: gone'),
        (
            changed(runner=Runner("cpython", "3.12", "x86_64")),
            "Python: cpython 3.11 on x86_64 was locked, this is cpython 3.12 on x86_64",
        ),
        (
            changed(packages=(PylockPackage("one", "1.1", LOCK.packages[0].wheels),)),
            "package one: 1.0 was locked, this is 1.1",
        ),
        (
            changed(packages=(PylockPackage("one", "1.0", (Wheel(A),)),)),
            f"package one==1.0: the file with SHA-256 {B[:12]}... was locked, there is {A[:12]}",
        ),
        (changed(packages=()), "package one: gone, 1.0 was locked"),
        (changed(assets=("org/a@1",)), "assets: none were locked, these are org/a@1"),
        (
            changed(spaces=Spaces('{"size": 8}', (dataclasses.replace(TASK, task=1),))),
            "environment suite/0: gone",
        ),
        (
            changed(spaces=Spaces('{"size": 8}', (OTHER_TASK,))),
            "environment suite/0: observations were Box(-1.0, 1.0, (3,), float32), now "
            "Box(-1.0, 2.0, (3,), float32)",
        ),
        (
            changed(spaces=Spaces('{"size": 8}', (dataclasses.replace(TASK, mode="SameStep"),))),
            "environment suite/0: autoreset mode NextStep, now SameStep",
        ),
    ],
)
def test_what_differs_is_said(now: LockFile, said: str) -> None:
    assert making.differences(LOCK, LOCK) == []
    of_other_arguments = Spaces("{}", (dataclasses.replace(TASK, mode="SameStep"),))
    assert making.differences(LOCK, changed(spaces=of_other_arguments)) == []
    found = making.differences(LOCK, now)
    assert said in found
    with pytest.raises(LockDriftError) as caught:
        making.refuse(found, "org/repo")
    assert caught.value.drifts == tuple(found)
    assert isinstance(caught.value, EnvHubError)
    assert isinstance(caught.value, ValueError)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    "other",
    [
        gym.spaces.Box(-1, 1, (3,), np.float64),
        gym.spaces.Box(-1, 1, (1, 3), np.float32),
        gym.spaces.Box(np.array([-1, -1, -1]), np.array([1, 1, np.inf]), dtype=np.float32),
        gym.spaces.Dict(a=BOX),
        gym.spaces.Tuple([BOX]),
        gym.spaces.Discrete(3),
    ],
)
def test_no_two_spaces_look_alike(other: gym.Space[Any]) -> None:
    """Kind, shape, dtype and every bound count; what was drawn from one does not."""
    same = gym.spaces.Box(-1, 1, (3,), np.float32, seed=7)
    same.sample()
    assert fingerprint_of_spaces(same) == fingerprint_of_spaces(BOX)
    assert fingerprint_of_spaces(other) != fingerprint_of_spaces(BOX)
    assert fingerprint_of_spaces(BOX, other) != fingerprint_of_spaces(other, BOX)


def test_spaces_are_held_against_the_lock_for_the_same_arguments() -> None:
    """With others the repository may make others; so it may with ``cfg``."""
    manifest = Manifest(envs=(wire.env_manifest(BOX, gym.spaces.Discrete(2), 2),), lazy=True)
    env = manifest.envs[0]
    key = (env.suite, env.task, env.autoreset_mode, BOX)
    same, other = (fingerprint_of_task(*key, gym.spaces.Discrete(count)) for count in (2, 3))

    def check(task: Any, given: dict[str, Any], config: object = None) -> None:
        lock = changed(spaces=Spaces('{"size": 8}', (task,)))
        RepositoryPackages(AUTO, None, lock).check(manifest, "org/repo", given, config)

    check(same, {"size": 8})
    check(other, {"size": 9})
    check(other, {"size": 8}, config={"a": 1})
    with pytest.raises(LockDriftError, match="actions were"):
        check(other, {"size": 8})
    for lock in (None, changed(spaces=None)):
        RepositoryPackages(AUTO, None, lock).check(manifest, "org/repo", {}, None)


def spoiled(tmp_path: Path, change: Callable[[str], str]) -> Path:
    text = lockfile.written(LOCK)
    assert change(text) != text
    path = tmp_path / "pylock.repo.toml"
    path.write_text(change(text))
    return path


def put(old: str, new: str) -> Callable[[str], str]:
    return lambda text: text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (put('name = "one"', 'name = "one\\n--index-url http://evil"'), "not a normalized name"),
        (put('\nversion = "1.0"', '\nversion = "1.0 \\\\\\n--pre"'), "no version"),
        (put(A, "a" * 63 + "\\n"), "no SHA-256"),
        (put("wheels = [", "wheelz = ["), "no list of 1 to"),
        (put("wheels = [", "vcs = { type = 'git' }\nwheels = ["), "only wheels of an index"),
        (put("wheels = [", "marker = 'x'\nwheels = ["), "only wheels of an index"),
        (
            put('\nversion = "1.0"\n', '\nversion = "1.0"\ndirectory = { path = "." }\n'),
            "directory",
        ),
        (put('extra = ["scipy>=1.11"]', 'extra = ["-r other.txt"]'), "-r other.txt"),
        (put("scipy>=1.11", "x; python_version > '\\\\n-e .'"), "Only plain requirements"),
        (put("2026-01-31", "2026-01-31 --pre"), "exclude-newer"),
        (put('python = "3.11"', 'python = "/tmp/evil/python"'), "python"),
        (put('commit = "0', 'commit = "../'), "commit"),
        (put("format = 1", "format = 2"), "another release"),
        (put("[tool.envhub]\n", "[tool.other]\n"), "another program"),
        (put('lock-version = "1.0"', 'lock-version = "9"'), "not a lock file"),
        (put("task = 0", "task = 0.5"), "tasks"),
        (put("[[packages]]", f"[[packages]]\n{'.'.join('a' * 3000)} = 1"), "dots"),
        (put('"env.py"', '"""env.py"""'), "several lines"),
        (lambda text: text + "[" * 5000, "not valid TOML"),
        (lambda text: "", "not a lock file"),
    ],
)
def test_no_other_lock_is_taken(tmp_path: Path, change: Callable[[str], str], said: str) -> None:
    """By what is wrong with it; nothing of it becomes an option, a path or a line for uv."""
    with pytest.raises(LockError, match=said):
        lockfile.read(spoiled(tmp_path, change))


def test_dots_cannot_be_hidden_from_the_count() -> None:
    """A parser takes long for a key of many parts, wherever it stands on the line."""
    key = ".".join("a" * 3000)
    for text in (f"'\"'.{key}.'\"' = 1", f'"\\"".{key}."x" = 1', f"a = 1 # '\n{key} = 1 # '"):
        with pytest.raises(LockError, match="dots"):
            pylock.document(text, "it")
    assert pylock.document(f"a = '{key}'", "it") == {"a": key}


def test_a_name_with_a_line_end_would_be_obeyed(index: Index, tmp_path: Path) -> None:
    """The control of what is refused: uv takes the second line for an option."""
    folder = tmp_path / "evil"
    folder.mkdir()
    make_wheel(folder, "one")
    with served(folder) as evil:
        name = f"--extra-index-url {evil.url}\none"
        lock = changed(packages=(PylockPackage(name, "1.0", (Wheel(A),)),))
        pins = resolve.pins(lock.packages).text.replace(f" \\\n    --hash=sha256:{A}", "")
        command = ["pip", "compile", "-", *uv.NO_BUILDS, "--python", PYTHON]
        uv.run(command, what="the control", given=pins, timeout_s=300)
        assert evil.asked
        evil.asked.clear()
        lockfile.write(lock, tmp_path / "pylock.toml")
        with pytest.raises(LockError, match="normalized"):
            lockfile.read(tmp_path / "pylock.toml")
        assert evil.asked == []
