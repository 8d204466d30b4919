"""Environments: made once, complete or not there, read-only, and of use without any index."""

import contextlib
import errno
import importlib.util
import os
import shutil
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages import bounds, environments
from envhub_sandbox.extras.packages.environments import Environment
from envhub_sandbox.extras.packages.packages import ThisMachine
from envhub_sandbox.extras.packages.request import chosen, request_of
from envhub_sandbox.extras.packages.resolution import index as index_settings
from envhub_sandbox.extras.packages.resolution import uv
from envhub_sandbox.hub.snapshot import local
from envhub_sandbox.system.locks import SharedLock
from envhub_worker.protocol.runtime import RECORD
from tests.support import inside
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import Index, make_wheel
from tests.support.processes import eventually

OWN = chosen({}, None)[0]
CHECKOUT = Path(__file__).resolve().parents[3]


def repository(folder: Path, *lines: str) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "env.py").write_text("")
    (folder / "requirements.txt").write_text("".join(f"{line}\n" for line in lines))
    return folder


def made(folder: Path, **options: Any) -> Environment:
    tell = options.pop("tell", lambda line: None)
    request = request_of(local(folder), OWN)
    return ThisMachine(**options).make(request, tell).environment


def left_behind() -> list[str]:
    return [path.name for path in environments.root().glob(".*")]


def known(folder: Path) -> Environment:
    """One that is made and removed: versions are known, and packages have to be downloaded."""
    env = made(folder)
    assert environments.remove(env) == ""
    shutil.rmtree(folder.parent / "uv")
    return env


def test_packages_lie_in_a_folder_that_nobody_can_write(index: Index, tmp_path: Path) -> None:
    """With what they need, what the worker imports, and bytecode; the pins are told. Jails of root
    are another user: all can read it, whatever the umask was."""
    make_wheel(index.folder, "wanted")
    before = os.umask(0o077)
    try:
        env = made(repository(tmp_path / "repo", "wanted"))
    finally:
        os.umask(before)
    assert (env.packages / "wanted/__init__.py").is_file()
    assert (env.packages / "numpy/__init__.py").is_file()
    assert "wanted==1.0" in env.pins
    assert os.path.isabs(env.python)
    assert left_behind() == []
    for path in [env.packages, *env.packages.rglob("*")]:
        mode = stat.S_IMODE(path.lstat().st_mode)
        assert not mode & 0o222, path
        assert mode & 0o444 == 0o444, path
        assert mode & 0o111 == 0o111 or not path.is_dir(), path
    code = "import sys; print(sys.implementation.cache_tag)"
    tag = subprocess.check_output([env.python, "-I", "-S", "-c", code], text=True).strip()
    source = str(env.packages / "wanted/__init__.py")
    compiled = Path(importlib.util.cache_from_source(source)).parent / f"__init__.{tag}.pyc"
    assert compiled.is_file()


def test_a_cache_below_a_folder_of_tests_has_bytecode(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path / "tests/cache"))
    files = {"wanted/a.py": "", "wanted/tests/b.py": "", "wanted/old.py": "print 'of another age'"}
    make_wheel(index.folder, "wanted", files=files)
    env = made(repository(tmp_path / "repo", "wanted"))
    assert len([*env.packages.glob("wanted/__pycache__/a.*.pyc")]) == 1
    assert [*env.packages.glob("wanted/tests/__pycache__/*.pyc")] == []
    assert (env.packages / "wanted/old.py").is_file(), "what cannot be compiled is no error"


def test_the_same_again_asks_nobody(index: Index, tmp_path: Path) -> None:
    first = made(repository(tmp_path / "a", "numpy"))
    index.broken, asked = 503, len(index.asked)
    assert made(tmp_path / "a").home == first.home
    assert len(index.asked) == asked
    index.broken = 0
    again = [made(repository(tmp_path / name, *lines)) for name, lines in _ALIKE.items()]
    assert {env.home for env in again} == {first.home}
    make_wheel(index.folder, "wanted")
    assert made(repository(tmp_path / "d", "wanted")).home != first.home


_ALIKE = {"b": ("numpy",), "c": ("numpy>=2", "msgpack")}


@pytest.mark.parametrize("damage", ["environment.json", "resolutions"])
def test_what_lost_its_content_is_made_again(index: Index, tmp_path: Path, damage: str) -> None:
    """A machine that loses its power may leave empty files behind."""
    folder = repository(tmp_path / "repo", "numpy")
    env = made(folder)
    if damage == "resolutions":
        [path] = (environments.root().parent / damage).iterdir()
        path.write_text("")
    else:
        (env.home / damage).write_text("")
        assert environments.ready(env.key) is None
    assert made(folder) == env
    assert environments.ready(env.key) == env
    assert left_behind() == []


MAKER = """\
import sys
from tests.integration.packages.test_environments import made
from pathlib import Path
print(made(Path(sys.argv[1])).home, flush=True)
"""


def maker(folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", MAKER, str(folder)],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=CHECKOUT,
    )


def test_several_processes_make_it_once(index: Index, tmp_path: Path) -> None:
    make_wheel(index.folder, "wanted")
    folder = repository(tmp_path / "repo", "wanted")
    asked = []
    for count in (1, 1, 3):  # the first one chooses versions as well; three download what one does
        for env in environments.every():
            environments.remove(env)
            subprocess.run(["rm", "-r", str(tmp_path / "uv")], check=True)
        index.asked.clear()
        makers = [maker(folder) for _ in range(count)]
        homes = {process.communicate()[0] for process in makers}
        assert [process.returncode for process in makers] == [0] * count
        assert len(homes) == 1
        asked.append(sorted(index.asked))
    assert any("wanted" in path for path in asked[1])
    assert asked[2] == asked[1]
    assert left_behind() == []


KILLED = """\
import sys, time
from pathlib import Path
from tests.support import inside
from tests.integration.packages.test_environments import made

def stop(*given, **named):
    Path(sys.argv[3]).touch()
    time.sleep(600)

setattr(*inside.making_an_environment(sys.argv[2]), stop)
made(Path(sys.argv[1]))
"""


@pytest.mark.parametrize("step", ["install", "publish"])
def test_killed_makers_leave_nothing_that_is_used(index: Index, tmp_path: Path, step: str) -> None:
    make_wheel(index.folder, "wanted")
    folder, reached = repository(tmp_path / "repo", "wanted"), tmp_path / "reached"
    words = [sys.executable, "-c", KILLED, str(folder), step, str(reached)]
    process = subprocess.Popen(words, cwd=CHECKOUT)
    try:
        assert eventually(reached.exists)
    finally:
        process.kill()
        process.wait()
    assert left_behind() != []
    assert environments.every() == []
    assert (made(folder).packages / "wanted/__init__.py").is_file()
    assert left_behind() == []


def test_what_a_killed_maker_started_is_waited_for(index: Index, tmp_path: Path) -> None:
    """uv outlives it, and still writes: nobody removes that from under it, or uses it."""
    make_wheel(index.folder, "wanted")
    folder = repository(tmp_path / "repo", "wanted")
    known(folder)
    told: list[str] = []
    index.hold("/files/wanted")
    process = subprocess.Popen([sys.executable, "-c", MAKER, str(folder)], cwd=CHECKOUT)
    assert eventually(lambda: bool(left_behind()) or process.poll() is not None)
    assert eventually(index.held)
    process.kill()
    process.wait()
    [half] = left_behind()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(made, folder, tell=told.append)
        try:
            assert eventually(lambda: any("another process" in line for line in told))
            assert left_behind() == [half]
        finally:
            index.let_go()
        env = waiting.result()
    assert (env.packages / "wanted/__init__.py").is_file()
    assert left_behind() == []


def test_one_that_is_used_stays_and_the_answer_names_its_user(index: Index, tmp_path: Path) -> None:
    """By a server that could start a jail, or a client whose environment could. What is half made
    is collected, but not what somebody is making. Where others can write nothing is used: somebody
    could have put another package in its place."""
    env = made(repository(tmp_path / "repo"))
    half = environments.root() / ".building-0123-x"
    (half / "packages").mkdir(parents=True)
    shutil.copy(env.home / "environment.json", half)
    (half / "packages").chmod(0o555)
    assert environments.every() == [env], "nobody removes it under its maker's hands"
    environments.remove_abandoned()
    assert left_behind() == []
    used = SharedLock(env.home / RECORD)
    why = environments.remove(env)
    assert f"{env.key[:12]} is in use by process {os.getpid()} (" in why
    assert environments.every() == [env]
    used.release()
    environments.root().chmod(0o777)
    with pytest.raises(DependencyError, match="other users"):
        made(tmp_path / "repo")
    environments.root().chmod(0o755)
    assert environments.remove(env) == ""
    assert (environments.every(), left_behind()) == ([], [])
    assert made(tmp_path / "repo").home == env.home


def test_what_fails_after_choosing_leaves_nothing(index: Index, tmp_path: Path) -> None:
    wheel = make_wheel(index.folder, "wanted")
    folder = repository(tmp_path / "repo", "wanted")
    known(folder)
    index.replaced[wheel.name] = make_wheel(tmp_path, "wanted", files={"evil.py": ""}).read_bytes()
    with refused_dependency("integrity", match="replaced"):
        made(folder)
    index.broken = 503
    with refused_dependency("index"):
        made(folder)
    assert environments.every() == []
    assert left_behind() == []


def test_a_full_disk_is_said(index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = made(repository(tmp_path / "other"))
    make_wheel(index.folder, "wanted")

    def full(*given: object, **named: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(*inside.making_an_environment("close"), full)
    with pytest.raises(DependencyError, match="envhub cache remove"):
        made(repository(tmp_path / "repo", "wanted"))
    assert environments.every() == [kept]
    assert left_behind() == []


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"wanted/one.bin": b"0" * 2**21}, "a file would have become larger than 1048576 bytes"),
        ({f"wanted/{n}.bin": b"0" * 2**18 for n in range(6)}, "at most 1 MiB are installed"),
        ({f"wanted/{n}.py": "" for n in range(100)}, "at most 60 are installed"),
    ],
    ids=["a large file", "many large files", "many files"],
)
def test_what_is_too_large_is_not_made(
    index: Index,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    files: dict[str, str | bytes],
    said: str,
) -> None:
    """And does not have to be unpacked to its end; who wants it can have it."""
    make_wheel(index.folder, "wanted", files=files)
    folder = repository(tmp_path / "repo", "wanted")
    with monkeypatch.context() as patch:
        patch.setenv(bounds.BYTES_VARIABLE, str(2**20))
        patch.setenv(bounds.FILES_VARIABLE, "60")
        with refused_dependency("size", match=said):
            made(folder)
        assert environments.every() == []
        assert left_behind() == []
        unpacked = {path.name for path in bounds.walk(tmp_path / "uv")}
        assert not unpacked & {Path(name).name for name in files}  # nor does uv keep it
        patch.setenv(bounds.BYTES_VARIABLE, "much")
        with pytest.raises(DependencyError, match=r"ENVHUB_ENVIRONMENT_BYTES is 'much'"):
            made(folder)
    assert (made(folder).packages / "wanted").is_dir()


def test_what_another_uv_unpacks_is_left_to_it(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its temporary folders look like those of one that was ended; then nobody is at work."""
    make_wheel(index.folder, "wanted")
    (tmp_path / "uv/.tmpours").mkdir(parents=True)
    monkeypatch.setattr(uv, "CACHE_WAIT_S", 0.0)
    index.hold("/files/wanted")
    with ThreadPoolExecutor(1) as pool:
        making = pool.submit(made, repository(tmp_path / "repo", "wanted"))
        try:
            assert eventually(lambda: index.held() or making.done())
            refused()
            assert (tmp_path / "uv/.tmpours").is_dir()
        finally:
            index.let_go()
        making.result(timeout=120)
    refused()
    assert not (tmp_path / "uv/.tmpours").exists()


def refused() -> None:
    with contextlib.suppress(DependencyError), uv.cleared_after_refusal(["none==1"]):
        (index_settings.uv_cache() / ".tmpours").touch()
        raise DependencyError("another hash", reason="integrity")


def test_what_is_announced_counts_before_it_is_there(tmp_path: Path) -> None:
    """uv says what it downloads; a package is no smaller once it is unpacked."""
    watch = bounds.Watch(bounds.Bounds(2**30, 1000), tmp_path, [tmp_path / "none/yet"])
    for line in ("Downloading scipy (33.7MiB)", "Prepared 3 packages in 4s", "Downloading 9GiB"):
        watch.hear(line)
    watch.look()
    watch.hear("Downloading torch (1.5GiB)")
    with refused_dependency("size", match=r"downloads of 1\.53 GiB; at most 1 GiB"):
        watch.look()


def test_a_full_disk_ends_it(index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While packages come, and before they do: somebody else needs what is left."""
    make_wheel(index.folder, "wanted")
    folder = repository(tmp_path / "repo", "wanted")
    known(folder)
    index.hold("/files/wanted")
    with ThreadPoolExecutor(1) as pool:
        making = pool.submit(made, folder)
        try:
            assert eventually(lambda: index.held() or making.done())
            monkeypatch.setattr(bounds, "LEFT_FREE", 2**62)
            with pytest.raises(DependencyError, match="envhub cache remove"):
                making.result(timeout=120)
        finally:
            index.let_go()
    with pytest.raises(DependencyError, match="is full"):
        made(folder)
    assert environments.every() == []
    assert left_behind() == []


def test_a_script_lies_where_the_others_do(index: Index, tmp_path: Path) -> None:
    """Whatever the wheel calls it: nothing is written elsewhere, and nothing is kept."""
    outside = tmp_path / "outside"
    outside.mkdir()
    for version, script in (("1.0", "../../escaped"), ("2.0", f"{outside}/escaped")):
        points = f"[console_scripts]\n{script} = wanted:main\n"
        files = {"wanted.py": "", f"wanted-{version}.dist-info/entry_points.txt": points}
        make_wheel(index.folder, "wanted", version, files=files)
        with pytest.raises(DependencyError, match="could not be installed"):
            made(repository(tmp_path / version, f"wanted=={version}"))
    assert [*outside.iterdir(), *tmp_path.rglob("escaped")] == []
    assert left_behind() == []
