"""Every block of code in the documents is executed, or held against what it talks about."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import inspect
import re
import shlex
from collections.abc import Iterator
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from envhub_sandbox.cli.app import app
from tests import libraries
from tests.support.documents import blocks, shell
from tests.support.documents.blocks import CHECKOUT, DRAWN, HELD, OWN, PARSED, RUN, SHOWN, Block

pytestmark = pytest.mark.same_for("users", "versions")

# Programs of others, whose options are theirs; and what begins a line that is no command.
_OTHERS = {"docker", "pip", "lerobot-eval", "lerobot-train", "lerobot-eval-sandboxed", "ruff"}
_OTHERS |= {"hf", "sbatch"}
_SHELL = "tests/support/documents/shell.py"
_RUN_BY = {
    "README.md": "tests/unit/docs/test_docs.py",
    "docs/integrations.md": "tests/unit/docs/test_docs.py",
    "docs/async.md": "tests/integration/documents/test_python.py",
    "docs/authors.md": "tests/integration/documents/test_python.py",
    "docs/concepts.md": "tests/integration/documents/test_python.py",
    "docs/deployment.md": _SHELL,
    "docs/observing.md": "tests/integration/documents/test_python.py",
    "docs/quickstart.md": "tests/integration/documents/test_python.py",
    "docs/scaling.md": "tests/integration/fleet/test_document.py",
}


def named(block: Block) -> str:
    return f"{block.document}: {block.text.strip().splitlines()[0][:40]}"


def test_every_block_has_a_way_and_every_way_a_block() -> None:
    """None is skipped in silence, and nothing is said of blocks that there are not."""
    there = list(blocks.blocks())
    assert {block.way for block in there} == {RUN, OWN, HELD, PARSED, SHOWN, DRAWN}
    assert set(blocks.TABLE) <= {(block.document, block.language) for block in there}
    for table in (blocks.APART, blocks.NOT_EXECUTED):
        for document, beginning in table:
            begun = [one for one in there if one.text.startswith(beginning)]
            assert any(one.document == document for one in begun), (document, beginning)


def test_what_is_executed_has_its_test() -> None:
    """Python by the test that names its document, shell by that of all, the rest by its own."""
    python = {block.document for block in blocks.tested(RUN) if block.language == "python"}
    assert python <= set(_RUN_BY)
    for document in python:
        assert f'"{document}"' in (CHECKOUT / _RUN_BY[document]).read_text()
    assert all((CHECKOUT / path).is_file() for path in blocks.APART.values())
    assert {block.language for block in blocks.tested(HELD)} == {"sh"}  # all Python is executed
    with_shell = {block.document for block in blocks.tested(RUN) if block.language == "sh"}
    assert with_shell <= {one for one in blocks.DOCUMENTS if shell.executed(one)}


def test_no_code_is_merely_indented() -> None:
    for document in blocks.DOCUMENTS:
        text = re.sub(r"^```.*?^```$", "", (CHECKOUT / document).read_text(), flags=re.M | re.S)
        assert re.findall(r"^[^\s*-].*\n\n {4}\S.*$", text, re.M) == [], document


def commands(text: str) -> Iterator[list[str]]:
    """The words of each command, without comments, variables and folders of programs."""
    text = re.sub(r"<[^>\n]*>", "X", text.replace("\\\n", " "))
    for line in text.splitlines():
        for command in line.split("&&"):
            words = shlex.split(command, comments=True)
            if words and words[0] not in ("cd", "."):
                yield [words[0].removeprefix(".venv/bin/"), *words[1:]]


@pytest.mark.parametrize(
    "block", [one for one in blocks.blocks() if one.language == "sh"], ids=named
)
def test_commands_are_ones_that_there_are(block: Block) -> None:
    for words in commands(block.text):
        held(words)


@pytest.mark.parametrize("block", blocks.tested(SHOWN), ids=named)
def test_commands_that_are_shown_with_their_output_are_too(block: Block) -> None:
    for line in re.findall(r"^\$ (.*)$", block.text, re.M):
        for words in commands(line):
            held(words)


def held(words: list[str]) -> None:
    """One command is one that there is, or this fails."""
    program, *rest = words
    if program == "envhub":
        done = CliRunner().invoke(app, [*(word for word in rest if word != "..."), "--help"])
        assert done.exit_code == 0, (words, done.output)
    elif program == "envhub-worker":
        parser = argparse.ArgumentParser()
        importlib.import_module(f"envhub_worker.cli.{rest[0]}").add_arguments(parser)
        known = set(re.findall(r"--[\w-]+", parser.format_help()))
        assert {word for word in rest if word.startswith("--")} <= known
    elif program in ("python", "python3") and rest[0] == "-m":
        assert importlib.util.find_spec(rest[1]) is not None, words
    elif program == "pytest":
        ours = (CHECKOUT / "tests" / "support" / "plugins" / "selection.py").read_text()
        plugin = inspect.getsource(
            importlib.import_module("envhub_sandbox.integrations.pytest_plugin")
        )
        long = [word for word in rest if word.startswith("--")]
        assert all(f'"{word}"' in ours + plugin for word in long), words
    elif program == "bash":
        assert (CHECKOUT / rest[0]).is_file(), words
        assert all((CHECKOUT / ".ci" / "steps" / f"{step}.sh").is_file() for step in rest[1:])
    else:
        assert program in _OTHERS or (CHECKOUT / program).is_file(), words


@pytest.mark.parametrize(
    "wrong",
    [
        "envhub rnu X",
        "envhub run X --episode-count 3",
        "envhub-worker listen --key-file X",
        "python -m tests.nothing_of_that_name",
        "bash .ci/run everything",
        "frobnicate",
    ],
)
def test_a_command_that_is_not_there_is_found(wrong: str) -> None:
    with pytest.raises(AssertionError):
        held(shlex.split(wrong))


def test_what_ci_takes_has_inputs_and_hooks_that_there_are(checkout: Any) -> None:
    parsed = [yaml.safe_load(block.text) for block in blocks.tested(PARSED)]
    workflows = [document for document in parsed if "jobs" in document]
    [hooks] = [document for document in parsed if "repos" in document]
    action = yaml.safe_load((checkout / "action.yml").read_text())
    for workflow in workflows:
        step = workflow["jobs"]["check"]["steps"][-1]
        assert set(step["with"]) <= set(action["inputs"])
    there = yaml.safe_load((checkout / ".pre-commit-hooks.yaml").read_text())
    assert {one["id"] for one in hooks["repos"][0]["hooks"]} <= {one["id"] for one in there}


def test_examples_that_pages_show_are_executed(checkout: Any) -> None:
    """A link to one that stands by itself is the example on the site; RLlib's is run by command."""
    page = (checkout / "docs" / "integrations.md").read_text()
    shown = re.findall(r"^\[examples/([\w/]+\.py)\]\(\.\./examples/\1\)$", page, re.M)
    executed = (checkout / "tests" / "integration" / "drop_in" / "test_examples.py").read_text()
    assert len(shown) == 4
    assert [name for name in shown if f'"{name}"' not in executed] == ["with_rllib.py"]
    assert "`python -m tests.libraries rllib`" in page
    tried = (checkout / "docs" / "internals" / "libraries-tried.md").read_text()
    rows = {library.replace("_", "-") for library in libraries.WANTED}
    assert rows <= set(re.findall(r"^\| ([\w-]+) \|", tried, re.MULTILINE))
