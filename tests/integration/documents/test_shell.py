"""The shell of the documents does what they say, word for word, against a Hub on loopback."""

from __future__ import annotations

import argparse
import importlib.util
import re
import runpy
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.hub.stub_hub import StubHub
from tests.support.documents import blocks
from tests.support.documents.blocks import Block
from tests.support.documents.shell import execute, executed

# What is about a repository is run within one.
_WITHIN = {"docs/ci.md": "my-env"}
# What is in no plain installation.
_NEEDS = {"--video": "imageio_ffmpeg", "--metrics": "prometheus_client"}
# What takes words, and no options.
_WITHOUT_PARSER = {"benchmarks.memory", "benchmarks.remote", "tests.distributions"}


@pytest.mark.parametrize("document", [one for one in blocks.DOCUMENTS if executed(one)])
def test_the_shell_of_a_document_runs(document: str, stub_hub: StubHub, tmp_path: Path) -> None:
    """All of its blocks, one after the other; each command ends well."""
    for option, needed in _NEEDS.items():
        if any(option in one.text for one in executed(document)):
            pytest.importorskip(needed)
    execute(executed(document), stub_hub, tmp_path, _WITHIN.get(document, ""))


@pytest.mark.parametrize(
    "wrong", ["false && true", "envhub-worker listen --frobnicate", "docker rm --force it"]
)
def test_a_block_that_fails_is_found(wrong: str, stub_hub: StubHub, tmp_path: Path) -> None:
    with pytest.raises(AssertionError):
        execute([Block("README.md", "sh", f"{wrong}\ntrue\n")], stub_hub, tmp_path)


class Taken(Exception):
    """The arguments are ones that there are."""


def long_ones() -> list[list[str]]:
    """A module and its arguments, of each ``python -m`` that is not executed."""
    texts = "".join(block.text for block in blocks.tested(blocks.HELD))
    lines = re.findall(r"^\S*python -m (.*)$", texts, re.MULTILINE)
    return [shlex.split(line, comments=True) for line in lines]


@pytest.mark.parametrize("words", long_ones(), ids=" ".join)
def test_what_is_too_long_takes_its_arguments(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    module, *arguments = words
    if module == "benchmarks":
        module, *arguments = f"benchmarks.{arguments[0]}", *arguments[1:]
    if module in _WITHOUT_PARSER:
        assert importlib.util.find_spec(module) is not None
        assert not any(word.startswith("-") for word in arguments)
        return
    parse = argparse.ArgumentParser.parse_args

    def parsed(self: argparse.ArgumentParser, *given: Any, **named: Any) -> None:
        parse(self, *given, **named)
        raise Taken

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parsed)
    monkeypatch.setattr(sys, "argv", [module, *arguments])
    for name in (module, f"{module}.__main__"):  # as a fresh interpreter would find it
        monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(Taken):
        runpy.run_module(module, run_name="__main__")
