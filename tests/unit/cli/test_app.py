"""What all commands have in common: their help, what a shell completes, and safe output."""

import ast
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

import envhub_sandbox.cli
from envhub_sandbox.cli.app import app, functions, whole_command
from envhub_sandbox.cli.shared import console
from envhub_sandbox.cli.shared.console import guarded, neutralised, out, say, show, show_rows
from tests.support.command_line import python
from tests.support.output.ci import obeyed
from tests.support.processes import eventually

_WIDTH = 80


def commands() -> Iterator[tuple[str, Any]]:
    """Every command, and those below others, by the words that call it."""
    waiting = [(name, whole_command(name)) for name in LISTED]
    while waiting:
        name, command = waiting.pop()
        below = getattr(command, "commands", {})
        waiting += [(f"{name} {one}".strip(), found) for one, found in below.items()]
        if not below:
            yield name, command


LISTED = typer.main.get_command(app).commands
_COMMANDS = dict(commands())


def help_of(name: str, width: int = _WIDTH, option: str = "--help-all") -> str:
    env = {"COLUMNS": str(width), "TERM": "dumb"}
    done = CliRunner().invoke(app, [*name.split(), option], env=env)
    assert done.exit_code == 0, done.output
    return done.output


def plain(text: str) -> str:
    return " ".join(re.sub("[│╭╮╰╯─]", " ", text).split())


@pytest.mark.parametrize("name", LISTED)
def test_the_list_of_commands_has_the_first_line_of_each(name: str) -> None:
    """It stands there once more, so that the list imports no command."""
    whole = whole_command(name)
    assert LISTED[name].help == whole.help.partition("\n\n")[0]
    assert set(functions(name)) == set(getattr(whole, "commands", {name: whole}))


_HEAVY = {"numpy", "gymnasium", "zmq", "huggingface_hub", "msgpack", "imageio_ffmpeg", "torch"}


@pytest.mark.parametrize(
    ("words", "shown", "unwanted"),
    [
        (["--help"], "doctor", {"envhub_sandbox.cli.run", "yaml"}),
        (["run", "--help"], "--episodes", set()),
    ],
)
def test_a_help_loads_nothing_heavy(words: list[str], shown: str, unwanted: set[str]) -> None:
    code = (
        f"import sys\nfrom envhub_sandbox.cli.app import app\napp({words}, standalone_mode=False)\n"
        f"sys.exit(' '.join({_HEAVY | unwanted} & set(sys.modules)) or 0)"
    )
    assert shown in python("-c", code).stdout


def test_the_help_has_what_most_need_and_says_how_to_see_the_rest() -> None:
    """Both in a terminal's usual width; the control is the whole help."""
    short, whole = help_of("run", 80, "--help"), help_of("run", 80)
    shown, every = (re.findall(r"^│[ *]*(--[\w-]+)", text, re.M) for text in (short, whole))
    assert {"--episodes", "--video", "--n-envs", "--sandbox", "--network"} < set(shown)
    assert len(shown) == 12
    assert short.count("\n") <= 50
    assert f"{len(every) - len(shown)} more options: envhub run --help-all" in short
    assert "more options" not in whole


@pytest.mark.parametrize("name", _COMMANDS)
def test_a_help_has_all_words_of_an_option(name: str) -> None:
    shown = plain(help_of(name, 1_000))
    texts = [one.help for one in _COMMANDS[name].params if getattr(one, "help", None)]
    for text in texts:
        assert " ".join(text.split()) in shown
    with_brackets = [one.help or "" for one in _COMMANDS["check"].params[1:]]
    assert any("[limits]" in one for one in with_brackets), "the control"


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        ("run --vid", {"--video"}),
        ("run x --network ", {"none", "loopback", "host"}),
        ("run x --profile ", {"strict", "no-userns", "container"}),
        ("check x --profile c", {"container"}),
        ("doctor --profile ", {"strict", "no-userns", "container"}),
        ("check x --fail-on ", {"error", "warning", "note"}),
        ("inspect x --fail-on w", {"warning"}),
        ("run x --dependencies ", {"auto", "declared", "host"}),
        ("run x --sandbox ", {"process", "docker", "ray", "tcp://", "none"}),
        ("check x --sandbox ", {"process", "docker", "ray", "tcp://"}),
    ],
)
def test_values_are_completed(words: str, completed: set[str]) -> None:
    typed = f"envhub {words}"
    variables = {
        "_ENVHUB_COMPLETE": "complete_bash",
        "COMP_WORDS": typed,
        "COMP_CWORD": str(len(typed.split(" ")) - 1),
    }
    done = CliRunner().invoke(app, prog_name="envhub", env=variables)
    assert set(done.output.split()) == completed


@pytest.mark.parametrize("words", ["check ./x --sandbox none", "replay ./x --sandbox none"])
def test_what_needs_a_sandbox_offers_no_way_without(words: str) -> None:
    name = words.split()[0]
    assert "none" not in re.findall(r"--sandbox.*", help_of(name, 1_000))[0]
    done = CliRunner().invoke(app, words.split())
    assert done.exit_code == 2
    assert "leave out --sandbox none" in done.output
    there = {option for one in _COMMANDS[name].params for option in one.opts}
    assert set(re.findall(r"--[a-z-]+", done.output)) <= there


_TEXTS = ("::error::x", "##[error]x", "##vso[task.a]x", "section_start:1:x", "section_end:1:x")


@pytest.mark.parametrize("command", _TEXTS)
@pytest.mark.parametrize("before", ["", "\n", "  ", "\n\t\x1b[31m ", "x\r", "x\u2028", "x\r\n\n "])
def test_no_command_is_left(command: str, before: str) -> None:
    """Whatever skips what stands before it; the control is the text itself."""
    assert obeyed(before + command)
    assert obeyed(neutralised(before + command)) == []


@given(st.lists(st.sampled_from([*"::##[ \n\rvso", "section_start", "x", "\x1b[1m"])))
def test_a_command_in_pieces_is_none(pieces: list[str]) -> None:
    whole = neutralised("".join(pieces))
    assert obeyed(whole) == []
    if not obeyed("".join(pieces)):
        assert whole == "".join(pieces)
    for text in ("a::b", "see x::y\n  a ::b", "# [x]", "[x]", "#", "section_start"):
        assert neutralised(text) == text, "in the middle of a line it is a name"
    runner = typer.Typer(cls=type(typer.main.get_command(app)))

    @runner.command("a")
    def one() -> None:
        import sys

        for piece in pieces:
            sys.stdout.write(piece)

    runner.command("b")(one)
    shown = CliRunner().invoke(runner, ["a"]).stdout
    assert obeyed(shown) == []


def test_nothing_is_folded(capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    """Whatever the number of columns is said to be: what is folded begins lines."""
    monkeypatch.setenv("COLUMNS", "20")
    words = "word " * 100 + "end"
    out(words)
    say(words, style="red")
    show_rows([("name", "n"), (words[:150], "1"), ("short", "10")], right=(1,))
    show("in", "/cache\nof them", stderr=True)
    shown = capsys.readouterr()
    assert shown.err == f"{words}\nin           /cache of them\n"
    first, head, long, short = shown.out.splitlines()
    assert first == words
    assert head.split() == ["name", "n"]
    assert long == f"{words[:150]}   1"
    assert short == f"{'short':150}  10"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run"], "Missing argument 'REF'. Try 'envhub run --help'."),
        (["run", "--bad", "."], "No such option: --bad. Try 'envhub run --help'."),
        (["run", "--seed"], "Option '--seed' requires an argument. Try 'envhub run --help'."),
        (
            ["verify", "FILE"],
            "There is no 'verify' any more: use 'envhub lock --check FILE'. Try 'envhub --help'.",
        ),
        (
            ["run", ".", "--server-key=KEY"],
            "There is no '--server-key' any more: use 'tcp://HOST:PORT KEY'. Try 'envhub --help'.",
        ),
    ],
)
def test_wrong_usage_is_one_message(words: list[str], says: str) -> None:
    done = CliRunner().invoke(app, words)
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr == f"Error: {says}\n"
    document = json.loads(CliRunner().invoke(app, [words[0], "--json", *words[1:]]).stdout)
    assert document == {"error": {"type": "UsageError", "message": says, "exit_code": 2}}


def test_one_place_writes() -> None:
    found = []
    for path in Path(next(iter(envhub_sandbox.cli.__path__))).rglob("*.py"):
        if path.name in ("console.py", "progress.py"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
            if called in ("print", "typer.echo", "sys.stdout.write", "sys.stderr.write", "console"):
                found.append(f"{path.name}:{getattr(node, 'lineno', 0)}: {called}")
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rich"):
                found.append(f"{path.name}:{node.lineno}: {node.module}")
    assert found == []


# --- How a command prints: what is printed is text and no more, whoever chose it


def in_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setenv("COLUMNS", "34")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)


def test_a_terminal_wraps_below_the_beginning(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long line, and the last column, under their texts; a path stays in one piece."""
    in_a_terminal(monkeypatch)
    show("note", "the card is missing, and so is /a/long/path/of/more/than/a/line")
    show_rows([("layer", "what it does"), ("memory", "8192 MiB, counted by the kernel; not file")])
    show_rows([("x" * 20, "one two three four five")])  # which the terminal wraps by itself
    margin = " " * 13
    assert capsys.readouterr().out.splitlines() == [
        "note         the card is missing,",
        f"{margin}and so is",
        f"{margin}/a/long/path/of/more/than/a/line",
        "layer   what it does",
        "memory  8192 MiB, counted by the",
        "        kernel; not file",
        f"{'x' * 20}  one two three four five",
    ]


def test_a_wrapped_line_begins_no_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A CI system skips blanks; the control is the same without the guard."""
    in_a_terminal(monkeypatch)
    rows = [("a", "a layer of a hostile server ::error::forged")]
    show_rows(rows)
    assert obeyed(capsys.readouterr().out) == ["::error::forged"]
    with guarded():
        show_rows(rows)
    shown = capsys.readouterr().out
    assert (len(shown.splitlines()), obeyed(shown)) == (2, [])


def test_what_takes_long_has_lines_in_a_log(capfd: pytest.CaptureFixture[str]) -> None:
    written: list[str] = []

    def lines() -> list[str]:
        written.append(capfd.readouterr().err)
        return "".join(written).splitlines()

    with console.ProgressBar(quiet=True, long_s=0.05) as bar:
        bar.begin("brief")
        bar.begin("a / 0: ::error::8 resets, round 1 of 4")
        assert eventually(lambda: len(lines()) >= 2)
    assert all("a / 0: " in line and line.endswith(" so far") for line in lines())
