"""Assets on another host: sent as the repository's own files are, and shown there read-only."""

from pathlib import Path

import pytest

from tests.hub.stub_hub import StubHub, StubRepository
from tests.remote.listening import listening
from tests.support.repositories import STILL
from tests.support.started import started

ENV = f"""{STILL}
from pathlib import Path
from huggingface_hub import hf_hub_download
class Reads(Still):
    def text(self):
        return Path(hf_hub_download("org/data", "mesh.txt", repo_type="dataset")).read_text()

    def write(self):
        Path(hf_hub_download("org/data", "mesh.txt", repo_type="dataset")).write_text("changed")
"""


def test_a_server_is_sent_assets(stub_hub: StubHub, hub_cache: Path, tmp_path: Path) -> None:
    """It needs neither the Hub nor a token; nobody can change them, and the next jail has them."""
    stub_hub.add("org/data", {"mesh.txt": "a mesh"}, "dataset")
    stub_hub.add("org/repo", {"env.py": ENV})
    given = {"endpoint": stub_hub.endpoint, "hub_cache_dir": hub_cache, "token": False}
    commit = StubRepository({}).commit
    with listening(tmp_path / "server") as server:
        for _ in range(2):
            place = {"sandbox": server.sandbox(), "assets": [f"datasets/org/data@{commit}"]}
            with started(f"org/repo@{commit}", **place, **given) as env:
                assert env.call("text") == ("a mesh",)
                with pytest.raises(OSError, match=r"Read-only|Permission"):
                    env.call("write")
