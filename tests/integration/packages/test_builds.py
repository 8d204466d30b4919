"""Sources become wheels in a jail, with what they are built with and nothing else; once."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import DependencyError
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.builds import wheels
from envhub_sandbox.extras.packages.declared import Source
from envhub_sandbox.extras.packages.locks import lockfile
from envhub_sandbox.extras.packages.locks.making import locked
from envhub_sandbox.extras.packages.request import Choice
from envhub_sandbox.extras.packages.resolution.resolutions import build
from envhub_sandbox.extras.sources import git_address as address
from envhub_sandbox.hub.snapshot import local
from envhub_sandbox.system.folders import cache_root, remove_tree
from tests.support.packages.git_server import git_served, make_repository
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.sdists import backend, make_sdist
from tests.support.packages.wheels import Index, make_wheel
from tests.support.repositories import importing, write_repository

OWN = interpreters.own()
IMPORTS = """
import {name}
def further():
    import sys, {name}
    return {{"seen.txt": repr(({name}.VERSION, [path for path in sys.path if "site-" in path]))}}
"""
ASKS = """
def get_requires_for_build_wheel(config_settings=None):
    return ["tool"]
def further():
    import tool
    return {"seen.txt": tool.VERSION}
"""
NAMED = """
def further():
    return {"builder/__init__.py": "VERSION = '1.0'\\n"}
"""


@pytest.fixture
def packages(index: Index) -> Index:
    """An index with a package that others are built with."""
    make_wheel(index.folder, "tool", "1.0")
    return index


def built(sources: list[Source], tell: Callable[[str], None] = lambda line: None) -> list[Path]:
    """A wheel of each, for this interpreter."""
    return build(sources, OWN, tell)


def seen(wheel: Path) -> str:
    with zipfile.ZipFile(wheel) as archive:
        return archive.read("seen.txt").decode()


def test_it_is_built_with_what_it_asks_for_and_once(packages: Index, tmp_path: Path) -> None:
    """The packages of no interpreter are among it; a second use needs no build and no index."""
    files = backend("x", needs=["tool<2"], further=IMPORTS.format(name="tool"))
    source = make_sdist(tmp_path, "x", files=files)
    said: list[str] = []
    [wheel] = built([source], said.append)
    assert seen(wheel) == "('1.0', [])"
    assert "building x 1.0 in a jail" in said
    known = wheels.describe(wheel)
    assert known is not None
    assert known.source.identity == f"sha256:{source.sha256}"
    (tmp_path / "x-1.0.tar.gz").unlink()
    said.clear()
    packages.broken = 503
    try:
        assert built([source], said.append) == [wheel]
    finally:
        packages.broken = 0
    assert said == []


def test_what_the_backend_asks_for_besides(packages: Index, tmp_path: Path) -> None:
    source = make_sdist(tmp_path, "asks", files=backend("asks", further=ASKS))
    [wheel] = built([source])
    assert seen(wheel) == "1.0"


def test_a_build_that_fails(packages: Index, tmp_path: Path) -> None:
    """The error names the package, where it is asked for, what is missing, and what was printed."""
    log = "error: command 'gcc' failed: No such file or directory"
    further = f"def further():\n    print('noise')\n    raise SystemExit({log!r})\n"
    source = make_sdist(tmp_path, "fails", files=backend("fails", further=further))
    with refused_dependency("resolution") as caught:
        built([source])
    for words in ("fails 1.0 (line 1 of x.txt)", "apt-get install gcc", "noise"):
        assert words in str(caught.value)


def test_a_commit_of_git(packages: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a branch, from a folder of it; the wheel says which commit it was."""
    monkeypatch.setattr(address, "PROTOCOLS", ("http",))
    served = tmp_path / "served" / "repo"
    files = {f"python/{name}": text for name, text in backend("x", "3.0").items()}
    commit = make_repository(served, files)
    with git_served(served.parent) as where:
        source = Source("x", "", f"{where}/repo", commit="main", subdirectory="python")
        [wheel] = built([source])
    assert wheel.name == "x-3.0-py3-none-any.whl"
    known = wheels.describe(wheel)
    assert known is not None
    assert known.source.identity == f"git+{where}/repo@{commit}#subdirectory=python"


ENV = importing("sourced", origin="sourced.FROM")


def test_a_repository_whose_package_has_no_wheel(real_index: Index, tmp_path: Path) -> None:
    """By its reference alone; what its package needs once it is installed has no wheel either."""
    shelf = real_index.folder
    make_sdist(shelf, "sourced", files=backend("sourced", requires=["further"]))
    further = backend("further", needs=["builder"], further=IMPORTS.format(name="builder"))
    make_sdist(shelf, "further", files=further)
    make_sdist(shelf, "builder", files=backend("builder", further=NAMED))
    folder = write_repository(tmp_path / "repo", ENV, requirements__txt="sourced\n")
    at_once = {"server_idle_s": 0.0}  # no server keeps what is removed below
    with make_env(folder, timeouts=at_once) as suites:
        assert suites.env.call("origin") == ("a source",)
        assert {"sourced==1.0", "further==1.0"} < set(suites.provenance["installed"]["packages"])
    snapshot = local(folder)
    lock = locked(snapshot, Choice("own"))
    path = tmp_path / "pylock.x.toml"
    lockfile.write(lock, path)
    assert lockfile.read(path) == lock
    [origin] = [one.origin for one in lock.packages if one.name == "sourced"]
    assert origin is not None
    for name in ("environments", "resolutions"):
        remove_tree(cache_root() / name)
    [kept] = wheels.root().glob("*/*/sourced-*.whl")
    remove_tree(kept.parent)
    with make_env(folder, lock=path, timeouts=at_once) as suites:
        assert suites.env.call("origin") == ("a source",)
    assert kept.exists(), "it was built again"
    remove_tree(kept.parent)
    remove_tree(cache_root() / "environments")
    real_index.replaced["sourced-1.0.tar.gz"] = b"another"
    with refused_dependency("integrity", match="it was replaced"):
        make_env(folder, lock=path)


def test_what_is_needed_to_build_itself(index: Index, tmp_path: Path) -> None:
    make_sdist(index.folder, "one", files=backend("one", needs=["two"]))
    source = make_sdist(index.folder, "two", files=backend("two", needs=["one"]))
    with refused_dependency("resolution", match="two <- one <- two"):
        built([source])


def test_no_jail_no_build(packages: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is built where nothing confines it; the error says what else may be chosen."""
    monkeypatch.setenv("ENVHUB_BUILD_PROFILE", "none-such")
    with pytest.raises(DependencyError, match="none-such"):
        built([make_sdist(tmp_path, "unbuilt")])
    assert not list(wheels.root().glob("*/*/unbuilt*"))
