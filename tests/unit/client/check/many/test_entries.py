"""Lists of references: what is wrong with one is told by its line, and no name is a path."""

from __future__ import annotations

import io
import re
from pathlib import Path

import pytest

from envhub_sandbox.check.many import entries
from envhub_sandbox.check.many.entries import ListEntry
from envhub_sandbox.errors import HubReferenceError

_COMMIT = "0123456789" * 4


def read(text: str | bytes) -> list[ListEntry]:
    """The references of a list."""
    data = text.encode() if isinstance(text, str) else text
    return entries.read_entries(io.BytesIO(data), "list.txt")


def test_one_reference_a_line(tmp_path: Path) -> None:
    """Comments, empty lines, Windows' ends of lines and a byte order mark are none."""
    (tmp_path / "my env").mkdir()
    text = f"\ufeff# ours\r\n\r\norg/repo@{_COMMIT}\r\n  spaces/a/b:x.py  \n{tmp_path}/my env\n"
    found = read(text)
    assert [(one.reference, one.line) for one in found] == [
        (f"org/repo@{_COMMIT}", 3),
        ("spaces/a/b:x.py", 4),
        (f"{tmp_path}/my env", 5),
    ]
    assert found[2].meaning == f"{tmp_path.resolve()}/my env:env.py"


def test_no_login_is_told() -> None:
    with pytest.raises(HubReferenceError) as raised:
        read("https://user:secret@huggingface.co/org/repo")
    assert "secret" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("org/repo\nrepo\n", "list.txt:2: .*owner is missing"),
        ("org/repo\n\norg/repo@main\n", "list.txt:3: .* already in line 1"),
        ("https://huggingface.co/org/repo\norg/repo", "list.txt:2: .* already in line 1"),
        ("./nowhere-to-be-found", "list.txt:1: .*no such folder"),
        ("../../etc/\x1b[2J", "list.txt:1: .*control characters"),
        ("org/../../etc", "list.txt:1: "),
        ("--sandbox=none", "list.txt:1: "),
        ("org/" + "x" * 5_000, "list.txt:1: "),
        (b"org/repo\n\xff\n", "list.txt:2: .*UTF-8"),
        ("org/repo\rrepo\r", "list.txt:2: .*owner is missing"),
        ("org/repo # ours", "list.txt:1: .*put a comment on its own line"),
        ("./:../env.py", "list.txt:1: .*outside its folder"),
        ("./:sub/../../env.py", "list.txt:1: .*outside its folder"),
        ("./:/etc/env.py", "list.txt:1: .*outside its folder"),
        ("# nothing\n", "has no reference"),
        ("#" * 2_000_000, "larger than"),
        ("\n".join(f"a/r{number}" for number in range(2_001)), "more than 2000"),
    ],
)
def test_what_is_wrong_is_told_by_its_line(text: str | bytes, says: str) -> None:
    with pytest.raises(HubReferenceError, match=f"(?s){says}"):
        read(text)


def test_all_that_is_wrong_is_told_at_once_and_bounded() -> None:
    with pytest.raises(HubReferenceError) as raised:
        read("\n".join(f"wrong{number}" for number in range(100)))
    told = str(raised.value)
    assert "list.txt:1: " in told
    assert "list.txt:20: " in told
    assert "and 80 more" in told
    assert "\x1b" not in told


def test_the_same_folder_by_another_way_is_told(tmp_path: Path) -> None:
    (tmp_path / "env").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "env")
    with pytest.raises(HubReferenceError, match=r":2: .* already in line 1"):
        read(f"{tmp_path}/env\n{tmp_path}/x/../link\n")


@pytest.mark.parametrize(
    "meaning",
    [
        "/a/../..:env.py",
        "/..:env.py",
        "/:env.py",
        "/home/-rf:env.py",
        "/home/<script>alert(1)</script>:env.py",
        "/home/\udcff/\u202e:env.py",
        "/" + "x" * 4_000 + ":env.py",
        "org/" + "x" * 96 + "@main:" + "y" * 200 + ".py",
        "CON/NUL@main",
    ],
)
def test_a_name_is_never_a_path(meaning: str) -> None:
    """Whatever a reference is called: letters, digits and dashes, and short."""
    name = ListEntry("x", meaning, 1).name
    assert re.fullmatch(r"[a-z0-9]([a-z0-9-]{0,70}[a-z0-9])?", name)


def test_no_two_have_the_same_name() -> None:
    """Though what people know of them is the same, or differs in case alone."""
    meanings = ["org/a-b@main", "org/a_b@main", "org/A-b@main", "org/a-b@dev", "/x/org/a-b:env.py"]
    names = {ListEntry("x", meaning, 1).name for meaning in meanings}
    assert len({name.lower() for name in names}) == len(meanings)
