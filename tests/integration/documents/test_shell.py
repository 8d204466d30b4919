"""The shell of the documents does what they say, word for word, against a Hub on loopback."""

from pathlib import Path

import pytest

from tests.hub.stub_hub import StubHub
from tests.support.documents import blocks
from tests.support.documents.blocks import Block
from tests.support.documents.shell import execute, executed

# What is about a repository is run within one.
_WITHIN = {"docs/ci.md": "my-env"}
# What is in no plain installation.
_NEEDS = {"--video": "imageio_ffmpeg", "--metrics": "prometheus_client"}


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
