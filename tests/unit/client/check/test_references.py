"""Lists of references: what is wrong with one is told by its line."""

import io
from pathlib import Path

import pytest

from envhub_sandbox.errors import HubReferenceError
from envhub_sandbox.extras.judge.references import ListEntry, read_entries

_COMMIT = "0123456789" * 4


def read(text: str) -> list[ListEntry]:
    return read_entries(io.BytesIO(text.encode(errors="surrogateescape")), "list.txt")


def test_one_reference_a_line(tmp_path: Path) -> None:
    (tmp_path / "my env").mkdir()
    text = f"\ufeff# ours\r\n\r\norg/repo@{_COMMIT}\r\n  spaces/a/b:x.py  \n{tmp_path}/my env\n"
    found = read(text)
    assert [(one.reference, one.line) for one in found] == [
        (f"org/repo@{_COMMIT}", 3),
        ("spaces/a/b:x.py", 4),
        (f"{tmp_path}/my env", 5),
    ]
    assert found[2].meaning == f"{tmp_path.resolve()}/my env:env.py"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("org/repo\nrepo\n", "list.txt:2: .*owner is missing"),
        ("org/repo\n\norg/repo@main\n", "list.txt:3: .* already in line 1"),
        ("https://huggingface.co/org/repo\norg/repo", "list.txt:2: .* already in line 1"),
        ("{0}/env\n{0}/x/../link\n", "list.txt:2: .* already in line 1"),
        ("./nowhere-to-be-found", "list.txt:1: .*no such folder"),
        ("../../etc/\x1b[2J", "list.txt:1: .*control characters"),
        ("org/../../etc", "list.txt:1: "),
        ("--sandbox=none", "list.txt:1: "),
        ("https://user:secret@huggingface.co/org/repo", "list.txt:1: "),
        ("org/" + "x" * 5_000, "list.txt:1: "),
        ("org/repo\n\udcff\n", "list.txt:2: .*UTF-8"),
        ("org/repo\rrepo\r", "list.txt:2: .*owner is missing"),
        ("org/repo # ours", "list.txt:1: .*put a comment on its own line"),
        ("./:../env.py", "list.txt:1: .*outside its folder"),
        ("./:sub/../../env.py", "list.txt:1: .*outside its folder"),
        ("./:/etc/env.py", "list.txt:1: .*outside its folder"),
        ("# nothing\n", "has no reference"),
        ("#" * 2_000_000, "larger than"),
        ("\n".join(f"a/r{number}" for number in range(2_001)), "more than 2000"),
        ("\n".join(f"wrong{n}" for n in range(100)), "list.txt:1: .*list.txt:20: .*and 80 more"),
    ],
    ids=range(20),
)
def test_all_that_is_wrong_is_told_by_its_line(text: str, says: str, tmp_path: Path) -> None:
    """Before anything is run; no login and no control character is repeated."""
    (tmp_path / "env").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "env")
    with pytest.raises(HubReferenceError, match=f"(?s){says}") as raised:
        read(text.replace("{0}", str(tmp_path)))
    assert "secret" not in str(raised.value)
    assert "\x1b" not in str(raised.value)
