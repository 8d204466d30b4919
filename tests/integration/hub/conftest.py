"""How a repository of the Hub that lies and fails is fetched."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import Snapshot, fetch
from tests.hub.stub_hub import StubHub, StubRepository

Fetch = Callable[..., Snapshot]


@pytest.fixture
def repository(stub_hub: StubHub) -> StubRepository:
    good = b"def make_env(n_envs=1, use_async_envs=False): ...\n"
    return stub_hub.add("org/repo", {"env.py": good, "assets/mesh.bin": b"m" * 5000})


@pytest.fixture
def get(stub_hub: StubHub, hub_cache: Path, repository: StubRepository) -> Fetch:
    def run(text: str = "models/org/repo", **rest: Any) -> Snapshot:
        arguments = {"hub_cache_dir": hub_cache, "token": False, "endpoint": stub_hub.endpoint}
        return fetch(HubRef.parse(text), **{**arguments, **rest})

    return run
