"""``envhub inspect --static`` and ``envhub diff``: read and compared, and nothing runs."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from envhub_sandbox.cli.app import app
from envhub_sandbox.extras.judge.changes import changes
from envhub_sandbox.extras.judge.checks import Severity
from envhub_sandbox.extras.judge.static import static
from envhub_sandbox.hub.listing import GIT_SHA1, FileRecord, Snapshot, digest_of
from envhub_sandbox.hub.snapshot import local
from envhub_worker.protocol.text import printable
from tests.support.output.ci import obeyed
from tests.support.repositories import write_repository

_ENTRY = """import gymnasium as gym
import yaml

def make_env(n_envs=1, use_async_envs=False, size=8):
    return eval("gym.make_vec('CartPole-v1')")
"""
_PAPERS = {"README__md": "# x", "LICENSE": "MIT"}


def envhub(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [*map(str, arguments)], prog_name="envhub")


def document(*arguments: str | Path, code: int = 0) -> dict[str, Any]:
    done = envhub(*arguments, "--json")
    assert done.exit_code == code, done.output
    read: dict[str, Any] = json.loads(done.stdout)
    return read


def repository(folder: Path, entry: str = _ENTRY, **files: str) -> Path:
    return write_repository(folder, entry, **_PAPERS, **files)


def test_a_repository_is_read(tmp_path: Path) -> None:
    folder = repository(tmp_path / "r", requirements__txt="PyYAML>=6\ngymnasium")
    read = document("inspect", "--static", folder)
    assert read["reference"] == f"{folder}:env.py"
    arguments = "n_envs=1, use_async_envs=False, size=8"
    assert read["entry"] == {"file": "env.py", "make_env": [{"arguments": arguments, "line": 4}]}
    paths = [one["path"] for one in read["files"]]
    assert paths == ["LICENSE", "README.md", "env.py", "requirements.txt"]
    assert read["declared"]["packages"] == ["PyYAML>=6", "gymnasium"]
    assert [(one["name"], one["brought"]) for one in read["imports"]] == [
        *(("gymnasium", True), ("yaml", False))
    ]
    [finding] = read["findings"]
    assert (finding["check"], finding["file"], finding["line"]) == ("source-dynamic", "env.py", 5)
    odd = repository(tmp_path / "odd", requirements__txt="x @ https://example.com/x.whl")
    refused = document("inspect", "--static", odd)
    assert refused["declared"] is None, "which is no reason not to read the rest"
    assert [one["check"] for one in refused["findings"]] == ["requirements", "source-dynamic"]
    shown = envhub("inspect", "--static", folder).stdout
    assert "make_env(n_envs=1, use_async_envs=False, size=8)" in shown
    assert "note         source-dynamic: env.py:5: uses eval" in shown


def test_nothing_of_it_runs(tmp_path: Path) -> None:
    """What leaves a trace when it is imported; the control imports it."""
    trace = tmp_path / "trace"
    text = f"open({str(trace)!r}, 'w').close()\ndef make_env(): pass\n"
    folder = repository(tmp_path / "r", text, sitecustomize__py=text, conftest__py=text)
    document("inspect", "--static", folder)
    document("diff", folder, folder)
    assert not trace.exists()
    subprocess.run([sys.executable, "-I", folder / "env.py"], check=True, timeout=120)
    assert trace.exists()


@pytest.mark.parametrize(("least", "code"), [("note", 1), ("warning", 0)])
def test_findings_fail_where_that_is_asked_for(least: str, code: int, tmp_path: Path) -> None:
    folder, sarif = repository(tmp_path / "r"), tmp_path / "sarif"
    done = envhub("inspect", "--static", folder, "--fail-on", least, "--sarif", sarif)
    assert done.exit_code == code
    [result] = json.loads(sarif.read_text())["runs"][0]["results"]
    assert (result["ruleId"], result["properties"]["fails"]) == ("source-dynamic", code == 1)


def test_a_repository_paints_and_commands_nothing(tmp_path: Path) -> None:
    """Neither a terminal nor GitHub's runner: not by names, not by texts, not by what differs."""
    quoted = "\n'''\n::error::forged\n##[error]forged\n'''\n"
    old = repository(tmp_path / "old", f"{_ENTRY}{quoted}")
    text = "##[error]forged ::error::forged\x9b2J" + " " * 60
    spoken = (
        f"open('~/' + '\\x1b[2J')\nopen({'~/' + text!r})\ndef make_env(a={text!r}): pass\n{quoted}"
    )
    new = repository(tmp_path / "new", spoken)
    names = ("##[error]forged", "::error::forged", "::error::" + "a" * 200 + "::error::b")
    for name in names:
        (new / name).write_text("\x1b[2J")
        assert obeyed(name), "the control: by themselves they are obeyed"
    for done in (
        envhub("inspect", "--static", new),
        envhub("inspect", "--static", new, "--json"),
        envhub("diff", old, new),
        envhub("diff", old, new, "--json"),
    ):
        assert "forged" in done.stdout
        assert obeyed(done.stdout) == []
        assert not {"\x1b", "\x9b", "\r"} & set(done.output)
    assert names[0] in {one["path"] for one in document("inspect", "--static", new)["files"]}


def differing(tmp_path: Path, entry: str = _ENTRY, **files: str) -> list[tuple[str, str, str]]:
    """How a changed repository differs from the first one: what, how, and in words."""
    old = repository(tmp_path / "old", requirements__txt="numpy>=1\nscipy", data__txt="the same")
    kept = {"requirements__txt": "numpy>=1\nscipy", "data__txt": "the same"}
    new = repository(tmp_path / "new", entry, **{**kept, **files})
    found = changes(static(local(old)), static(local(new)))
    return [(one.what, one.how, one.text) for one in found]


def test_what_is_the_same_differs_in_nothing(tmp_path: Path) -> None:
    assert differing(tmp_path / "a") == []
    moved = differing(tmp_path / "b", f"# a comment\n{_ENTRY}")
    assert [row[:2] for row in moved] == [("file", "changed")]
    done = envhub("diff", tmp_path / "b" / "old", tmp_path / "b" / "new")
    assert f"  | @@ -1,2 +1,3 @@\n  | +# a comment\n  |  {_ENTRY.splitlines()[0]}\n" in done.stdout
    old, new = repository(tmp_path / "old", a__txt="1"), repository(tmp_path / "new", b__txt="1")
    [one] = changes(static(local(old)), static(local(new)))
    assert (one.what, one.how, one.text) == ("file", "renamed", "b.txt: was a.txt")


def test_no_change_hides_behind_another(tmp_path: Path) -> None:
    old, new = repository(tmp_path / "old"), repository(tmp_path / "new")
    for number, blank in enumerate(("\f", "\x1c", "\x85", "\u2028")):
        comment, code = (f"x = {x}\n#{end}import os\n" for x, end in ((1, blank), (2, "\n")))
        assert "os" not in compile(comment, "", "exec").co_names, "the control: it is a comment"
        assert "os" in compile(code, "", "exec").co_names
        for folder, text in ((old, comment), (new, code)):
            (folder / f"{number}.py").write_text(text, "utf-8", newline="")
    for folder, name in ((old, "old"), (new, "new")):
        (folder / "long.txt").write_text(f"{name}\n{'é' * (1 << 19)}\n{name}\n", "utf-8")
    *sources, long = changes(static(local(old)), static(local(new)))[:5]
    assert [source.lines[-1] for source in sources] == ["+import os"] * 4
    assert long.lines[-1][:17] == "... there may be "


def test_each_change_is_told_as_what_it_is(tmp_path: Path) -> None:
    entry = _ENTRY.replace("import yaml", "import socket, torch").replace("size=8", "size=9")
    entry = entry.replace("'CartPole-v1'", "'Other-v1'")
    found = differing(
        tmp_path, entry, requirements__txt="numpy>=2\ntorch", data__txt="other", more__txt="1"
    )
    assert [row[:2] for row in found] == [
        *(("file", "changed"), ("file", "changed"), ("file", "new"), ("file", "changed")),
        ("entry", "changed"),
        *(("package", "changed"), ("package", "gone"), ("package", "new")),
        *(("import", "new"), ("import", "gone")),
        *(("finding", "new"), ("finding", "new"), ("finding", "gone")),
    ]
    texts = [text for _, _, text in found]
    assert "numpy>=1, now numpy>=2" in texts
    assert "env.py:2: imports socket" in texts
    assert texts.count("env.py:5: uses eval") == 2, "the line was changed: it is told again"


def test_what_has_no_line_is_new_if_changed(tmp_path: Path) -> None:
    """A pickle, code beyond what is read, a name too long to be printed; the control is no change,
    and a change of another file."""
    long = f"{'a' * 240}/{'b' * 240}/{'c' * 40}.py"
    texts = {
        "weights.pkl": ("one", "other"),
        "many.py": ("eval(x)\n" * 101, "eval(x)\n" * 101 + "eval(y)"),
        "large.py": ("x = 1\n" * 50_000, "x = 2\n" * 50_000),
        long: ("eval(x)", "eval(y)"),
    }
    old, new = repository(tmp_path / "old"), repository(tmp_path / "new")
    for name, (then, _) in texts.items():
        for folder in (old, new):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(then)
    (new / "README.md").write_text("# y")
    before = static(local(old))
    assert [row.what for row in changes(before, static(local(new)))] == ["file"]
    for name, (_, now) in texts.items():
        (new / name).write_text(now)
    found = changes(before, static(local(new)))
    weigh = {row.finding.file for row in found if row.finding and row.weighs(Severity.NOTE)}
    assert weigh == {printable(name, 500) for name in texts}


def test_a_folder_is_held_against_what_the_hub_has(tmp_path: Path) -> None:
    """The Hub gives other hashes than a folder's; the same bytes are no change."""
    folder = repository(tmp_path / "r")
    there = local(folder)
    records = [
        FileRecord(one.path, one.size, digest_of(folder / one.path, GIT_SHA1, one.size))
        for one in there.files
    ]
    hub = Snapshot("org/repo", "model", "0" * 40, "env.py", there.root, tuple(records))
    assert changes(static(hub), static(there)) == []
    assert changes(static(there), static(hub)) == []
    (folder / "README.md").write_text("# y")
    assert [one.text for one in changes(static(hub), static(local(folder)))] == [
        "README.md: 3 bytes, now 3 bytes"
    ]


def test_the_exit_code_says_if_pins_may_move(tmp_path: Path) -> None:
    old, new = repository(tmp_path / "old"), repository(tmp_path / "new", "import pty\n" + _ENTRY)
    assert document("diff", old, new, code=7)["same"] is False
    assert envhub("diff", old, old).exit_code == 0
    assert envhub("diff", new, old).exit_code == 7
    assert envhub("diff", old, new, "--fail-on", "note").exit_code == 1
    assert envhub("diff", new, old, "--fail-on", "note").exit_code == 0
    assert envhub("diff", old, new, "--fail-on", "warning").exit_code == 0
