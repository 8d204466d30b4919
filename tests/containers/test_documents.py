"""The blocks of ``docs/deployment.md`` about containers on this machine do what they say."""

import secrets
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from envhub_sandbox.extras.docker.engines import Engine
from tests.containers.kit import IMAGE
from tests.hub.stub_hub import StubHub
from tests.support.documents import blocks
from tests.support.documents.blocks import Block
from tests.support.documents.shell import execute

# The engine itself. The documents' image is the one under test, which is built already: the words
# of a build are held against the engine's own. A server has whichever port is free, and a name.
_DOCKER = """#!/bin/bash
set -euo pipefail
engine={engine}
if [ "$1" = build ]; then
  known=$($engine build --help)
  for word in "${{@:2}}"; do
    case $word in
      -t) [[ $known == *"-t, --tag "* ]] ;;
      --*) [[ $known == *" $word "* ]] ;;
      BASE_IMAGE=*) grep -q '^ARG BASE_IMAGE' {checkout}/Dockerfile ;;
      envhub-worker | .) ;;
      *) exit 64 ;;
    esac
  done
  exit 0
fi
words=()
for word in "$@"; do
  case $word in
    envhub-worker | envhub-worker:latest) word={image} ;;
    127.0.0.1:5555:5555) words+=(127.0.0.1::5555 --detach --name {name}); continue ;;
  esac
  words+=("$word")
done
exec $engine "${{words[@]}}"
"""


def ours(document: str) -> list[Block]:
    """What ``blocks.APART`` leaves to this of a document."""
    here = Path(__file__).relative_to(blocks.CHECKOUT).as_posix()
    return [
        one for one in blocks.tested(blocks.OWN) if (one.document, one.apart) == (document, here)
    ]


def of_this_engine(block: Block) -> Block:
    """The engine that Python names is the one that is here, by the name of the script above."""
    return replace(block, text=block.text.replace('engine="podman"', 'engine="docker"'))


@pytest.mark.parametrize(
    ("document", "languages"), [("README.md", {"sh"}), ("docs/deployment.md", {"sh", "python"})]
)
def test_the_blocks_about_containers_run(
    document: str, languages: set[str], engine: Engine, stub_hub: StubHub, tmp_path: Path
) -> None:
    """Shell and Python, one after the other; the server that is started there runs then."""
    assert {one.language for one in ours(document)} == languages
    name, command = f"envhub-test-{secrets.token_hex(6)}", shutil.which(engine.command)
    script, image = shlex.quote(command), shlex.quote(IMAGE)
    checkout = shlex.quote(str(blocks.CHECKOUT))
    docker = _DOCKER.format(engine=script, image=image, name=name, checkout=checkout)
    try:
        execute(map(of_this_engine, ours(document)), stub_hub, tmp_path, docker=docker)
        assert name in engine.run("ps", "--format", "{{.Names}}")
    finally:
        engine.run("rm", "--force", name)
