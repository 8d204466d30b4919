"""A wheel out of a jail is a stranger's: it is what was asked for, or it is refused."""

import stat
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.builds import wheels
from envhub_sandbox.extras.packages.declared import Source
from envhub_sandbox.extras.packages.interpreters import Interpreter
from tests.support.packages.refusals import refused_dependency
from tests.support.packages.wheels import make_wheel

pytestmark = pytest.mark.usefixtures("snapshot_store")
OWN = interpreters.own()


def check(wheel: Path, name: str = "some-name", version: str = "1.0") -> None:
    wheels.check(wheel, name, version, OWN)


def test_what_was_asked_for_is_taken(tmp_path: Path) -> None:
    check(make_wheel(tmp_path, "Some.Name"), version="1")
    minor = "".join(OWN.version.split(".")[:2])
    tag = f"cp{minor}-cp{minor}-linux_{OWN.machine}"
    wheel = make_wheel(tmp_path, "some-name", tag=tag)
    with zipfile.ZipFile(wheel, "a") as archive:
        archive.writestr("some_name/", "")
    check(wheel, version="")


@pytest.mark.parametrize(
    ("name", "version", "tag", "said"),
    [
        ("another", "1.0", "py3-none-any", "it is another 1.0, and not some-name 1.0"),
        ("some-name", "2.0", "py3-none-any", "it is some-name 2.0"),
        ("some-name", "1.0", "cp27-cp27m-linux_x86_64", "does not fit Python"),
        ("some-name", "1.0", "py3-none-win32", "does not fit Python"),
    ],
)
def test_others_are_refused(tmp_path: Path, name: str, version: str, tag: str, said: str) -> None:
    with refused_dependency("integrity", match=said):
        check(make_wheel(tmp_path, name, version, tag=tag))


def add(name: str, mode: int = 0o100644) -> Callable[[zipfile.ZipFile], None]:
    def change(archive: zipfile.ZipFile) -> None:
        member = zipfile.ZipInfo(name)
        member.external_attr = mode << 16
        archive.writestr(member, "x")

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (add("../out"), "'..' step"),
        (add("../out/", stat.S_IFDIR | 0o755), "'..' step"),
        (add("/etc/out"), "absolute name"),
        (add("link", stat.S_IFLNK | 0o777), "link or a device"),
        (add("pipe", stat.S_IFIFO | 0o644), "link or a device"),
        (add("unrecorded.py"), "lists other files"),
        (add("another-1.0.dist-info/METADATA"), "2 folders .dist-info"),
        (add("some_name/__init__.py"), "listed twice"),
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_what_no_wheel_has_is_refused(
    tmp_path: Path, change: Callable[[zipfile.ZipFile], None], said: str
) -> None:
    wheel = make_wheel(tmp_path, "some-name")
    with zipfile.ZipFile(wheel, "a") as archive:
        change(archive)
    with refused_dependency("integrity", match=said):
        check(wheel)


def test_what_its_files_say_is_held_against_them(tmp_path: Path) -> None:
    wheel = make_wheel(tmp_path, "some-name")
    check(wheel)
    with refused_dependency("integrity", match="not the file that its RECORD says"):
        check(rewritten(wheel, b"# changed\n"))
    for packing in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with refused_dependency("integrity", match="packed by a method that is not"):
            check(rewritten(wheel, packing=packing))
    for name, version in (("another", "1.0"), ("some-name", "2.0")):
        another = make_wheel(tmp_path, name, version).rename(wheel)
        with refused_dependency("integrity", match="its metadata are those of"):
            check(another)
    make_wheel(tmp_path, "some-name")
    for edit, said in (
        (("/METADATA", b"Name: ", b"Name: x"), "its metadata name the package"),
        (("/METADATA", b"Version: 1", b"Version: 2"), "its metadata name the version"),
        (("/RECORD", b"some_name", b"gone.py,,\nsome_name"), "lists other files"),
        (("/RECORD", b"some_name", b"x" * 200_000), "field larger than"),
    ):
        with refused_dependency("integrity", match=said):
            check(rewritten(wheel, edit=edit))
    for data in (b"", b"PK\5\6" + bytes(18), b"no zip"):
        wheel.write_bytes(data)
        with refused_dependency("integrity", match="is not taken"):
            check(wheel)


def rewritten(
    wheel: Path,
    changed: bytes = b"",
    packing: int = zipfile.ZIP_STORED,
    edit: tuple[str, bytes, bytes] = ("", b"", b""),
) -> Path:
    other = wheel.parent / "other" / wheel.name
    other.parent.mkdir(exist_ok=True)
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(other, "w", packing) as new:
        for member in old.infolist():
            is_code = member.filename.endswith("__init__.py")
            data = (is_code and changed) or old.read(member)
            data = data.replace(*edit[1:], 1) if member.filename.endswith(edit[0]) else data
            new.writestr(member.filename, data)
    return other


@pytest.mark.parametrize(
    ("bound", "value"),
    [("MAX_BYTES", 1), ("MAX_UNPACKED", 1), ("MAX_FILES", 1), ("MAX_TABLE", 4096)],
)
def test_bounds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bound: str, value: int) -> None:
    """Each of them holds; a table of contents is read at once, and its length its own word."""
    wheel = make_wheel(tmp_path, "some-name", files={f"some_name/{n}": "" for n in range(300)})
    check(wheel)
    monkeypatch.setattr(wheels, bound, value)
    with refused_dependency("integrity", match="too large" if value > 1 else None):
        check(wheel)


def test_metadata_are_read_to_their_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wheels, "MAX_TABLE", 1 << 20)
    wheel = make_wheel(tmp_path, "some-name")
    bomb = rewritten(wheel, b"", zipfile.ZIP_DEFLATED, ("/METADATA", b"Name", bytes(32 << 20)))
    tracemalloc.start()
    try:
        with refused_dependency("integrity", match="more than 1 MiB"):
            check(bomb)
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()


SOURCE = Source("toy", "1.0", "https://user:secret@index/toy-1.0.tar.gz", "a" * 64, where="line 3")
PYTHON = Interpreter("/usr/bin/python3", "cpython", "3.11.2", "x86_64", "2.36")
NAME = "toy-1.0-py3-none-any.whl"


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    built = tmp_path / NAME
    built.write_bytes(b"a wheel")
    return built


def test_what_is_kept_is_found_again(wheel: Path) -> None:
    assert wheels.recall(SOURCE, PYTHON) is None
    kept = wheels.keep(wheel, SOURCE, "e" * 64, PYTHON)
    assert kept == wheels.recall(SOURCE, PYTHON)
    assert kept.read_bytes() == b"a wheel"
    origin = wheels.describe(kept)
    assert origin.source == replace(SOURCE, url="https://index/toy-1.0.tar.gz", where="")
    assert "secret" not in (kept.parent / "built.json").read_text()
    assert wheels.recall(replace(SOURCE, sha256="b" * 64), PYTHON) is None
    assert wheels.recall(SOURCE, replace(PYTHON, version="3.12.0")) is None


def test_a_changed_wheel_is_none_and_is_replaced(wheel: Path) -> None:
    """Its hash stands beside it; a record that cannot be read is none either."""
    kept = wheels.keep(wheel, SOURCE, "e" * 64, PYTHON)
    kept.chmod(0o644)
    kept.write_bytes(b"another")
    assert wheels.recall(SOURCE, PYTHON) is None
    again = wheels.keep(wheel, SOURCE, "e" * 64, PYTHON)
    assert again.read_bytes() == b"a wheel"
    (again.parent / "built.json").write_text("{}")
    assert wheels.recall(SOURCE, PYTHON) is None
    assert wheels.describe(again) is None


def test_a_store_that_others_may_write_is_not_read(wheel: Path) -> None:
    wheels.keep(wheel, SOURCE, "e" * 64, PYTHON)
    wheels.root().chmod(0o777)
    assert wheels.recall(SOURCE, PYTHON) is None
    wheels.root().chmod(0o700)
    assert wheels.recall(SOURCE, PYTHON) is not None
