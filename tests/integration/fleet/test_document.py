"""The Python of docs/scaling.md does what the page says, with servers on loopback."""

from pathlib import Path
from typing import Any

import numpy as np

from envhub_sandbox import make_env
from tests.remote.listening import Listening
from tests.support.documents import blocks

DOCUMENT = "docs/scaling.md"


def test_the_python_of_the_page_runs(rows: Path, servers: list[Listening]) -> None:
    """Block by block, with what the page presupposes; the places are servers of this machine."""
    here = [server.sandbox() for server in servers[:2]]
    made: list[Any] = []

    def make(reference: str, *, sandbox: Any, n_envs: int, num_workers: int, **options: Any) -> Any:
        assert isinstance(sandbox, list)
        found = make_env(rows, sandbox=here, n_envs=n_envs, num_workers=num_workers, **options)
        made.append(found)
        return found

    def evaluate(env: Any) -> float:
        env.reset(seed=0)
        return float(env.step(np.zeros(env.num_envs, int))[1].sum())

    suites = make_env(rows, sandbox=here, n_envs=4)
    suites.env.reset()
    names: dict[str, Any] = {"make_env": make, "evaluate": evaluate, "suites": suites}
    names |= {"REF": "org/repo", "n_envs": 128, "world_size": 2, "rank": 1, "seed": 5}
    names["env"] = suites.env
    there = [one for one in blocks.tested(blocks.RUN) if one.document == DOCUMENT]
    texts = [one.text for one in there if one.language == "python"]
    assert len(texts) == 4
    for text in texts:
        exec(text, names)
    assert names["slowest"]["place"] in {one.endpoint for one in here}
    assert (names["returns"], names["env"].num_envs) == ({"hub_env": {0: 4.0}}, 64)
    for one in made:
        one.close()
