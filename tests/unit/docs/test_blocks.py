"""Every block of code in the documents is executed, or held against what it talks about."""

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
from tests.support.documents import blocks
from tests.support.documents.blocks import APART, CHECKOUT, NOT_EXECUTED, Block

# Programs of others, whose options are theirs.
_OTHERS = {"docker", "pip", "lerobot-eval", "lerobot-train", "lerobot-eval-sandboxed", "ruff"}
_OTHERS |= {"hf", "sbatch"}


def named(block: Block) -> str:
    return f"{block.document}: {block.text.strip().splitlines()[0][:40]}"


def test_what_is_said_of_blocks_is_said_of_blocks_that_there_are() -> None:
    there = [one for block in blocks.blocks() for one in block.named_in({*APART, *NOT_EXECUTED})]
    assert {*there} == {*APART, *NOT_EXECUTED}


def commands(text: str) -> Iterator[list[str]]:
    text = re.sub(r"<[^>\n]*>", "X", text.replace("\\\n", " "))
    for line in text.splitlines():
        for command in line.split("&&"):
            words = shlex.split(command, comments=True)
            if words and words[0] not in ("cd", "."):
                yield [words[0].removeprefix(".venv/bin/"), *words[1:]]


@pytest.mark.parametrize(
    "block", [one for one in blocks.blocks() if one.language in ("sh", "text", "")], ids=named
)
def test_commands_are_ones_that_there_are(block: Block) -> None:
    shown = "\n".join(re.findall(r"^\$ (.*)$", block.text, re.M))
    for words in commands(block.text if block.language == "sh" else shown):
        held(words)


def held(words: list[str]) -> None:
    program, *rest = words
    if program == "envhub":
        done = CliRunner().invoke(app, [*(word for word in rest if word != "..."), "--help"])
        assert done.exit_code == 0, (words, done.output)
    elif program == "envhub-worker":
        parser = argparse.ArgumentParser()
        importlib.import_module(f"envhub_worker.extras.access.commands.{rest[0]}").add_arguments(
            parser
        )
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
    parsed = [yaml.safe_load(block.text) for block in blocks.blocks() if block.language == "yaml"]
    workflows = [document for document in parsed if "jobs" in document]
    [hooks] = [document for document in parsed if "repos" in document]
    action = yaml.safe_load((checkout / "action.yml").read_text())
    for workflow in workflows:
        assert set(workflow["jobs"]["check"]["steps"][-1]["with"]) <= set(action["inputs"])
    there = yaml.safe_load((checkout / ".pre-commit-hooks.yaml").read_text())
    assert {one["id"] for one in hooks["repos"][0]["hooks"]} <= {one["id"] for one in there}
