"""``python -m benchmarks reach``: what it tries, and how it compares."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from benchmarks.reach import control, measure, table
from benchmarks.reach.cases import Case, cases
from benchmarks.reach.measure import Outcome
from envhub_sandbox.dependencies.declared import declared
from tests.support.processes import eventually

pytestmark = pytest.mark.same_for("users", "versions")

CASES = cases()
OUTCOME = Outcome("0", "package", "", "", "", "", (9.0, 1.0, 1.0), 1024, 12, "equal")
OUTCOMES = {
    "it runs": OUTCOME,
    "with help": replace(
        OUTCOME, alone="no wheel | at all. Nothing", argument='{"python": "3.12"}'
    ),
    "never": replace(OUTCOME, alone="no", helped="nor", argument="{}", seconds=(), control="runs"),
}
COUNTER = """
import gymnasium as gym
import numpy as np

class Counter(gym.Env):
    observation_space = gym.spaces.Dict({"n": gym.spaces.Box(0, 99, (2,), np.float32)})
    action_space = gym.spaces.Tuple((gym.spaces.Discrete(3), gym.spaces.Text(3)))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n = float(self.np_random.integers(9))
        return {"n": np.array([self.n, 0])}, {}

    def step(self, action):
        self.n += action[0] + len(action[1])
        return {"n": np.array([self.n, 1])}, self.n, self.n > 9, False, {}

def make_env(n_envs=1, use_async_envs=False):
    return VECTOR
"""


def test_there_are_as_many_as_it_says(tmp_path: Path) -> None:
    """At least forty packages, twenty repositories and a dozen of them in CI.

    Each has an entry file that is Python; what CI tries declares what it needs.
    """
    kinds = [case.kind for case in CASES.values()]
    assert kinds.count("package") >= 40
    assert kinds.count("repository") >= 20
    assert sum(case.quick for case in CASES.values()) >= 10
    for name, case in CASES.items():
        source = case.files[case.entry].decode()
        assert "make_env" in source, name
        compile(source, name, "exec")
        if case.quick:
            case.write(tmp_path / name)
            found = declared(tmp_path / name, case.entry)
            assert found is not None, name
            assert found.wanted, name


def test_the_table_stands_in_its_place(tmp_path: Path, monkeypatch: Any) -> None:
    """Between two lines of the document, each row with the cells of its head."""
    document = tmp_path / "dependencies.md"
    document.write_text(f"before\n{table.BEGIN}former\n{table.END}after\n")
    monkeypatch.setattr(table, "DOCUMENT", document)
    table.write(OUTCOMES)
    once = document.read_text()
    table.write(OUTCOMES)
    assert document.read_text() == once
    assert once.startswith("before\n")
    assert once.endswith("after\n")
    rows = [line for line in once.splitlines() if line.startswith("|")]
    assert len({row.replace("\\|", "").count("|") for row in rows}) == 1
    assert len(rows) == 2 + len(OUTCOMES)
    assert (
        "Of 3 packages, 3 run with a sandbox or without; 1 run by reference alone, 1 more" in once
    )
    assert "former" not in once


@pytest.mark.parametrize(
    "vector", ["Counter()", "{'a': [Counter()]}", "gym.vector.SyncVectorEnv([Counter])"]
)
def test_the_control_gives_what_gymnasium_gives(vector: str, tmp_path: Path) -> None:
    """By hand or as a vector: each line as of ``SyncVectorEnv`` here, in a process of its own."""
    (tmp_path / "env.py").write_text(COUNTER.replace("VECTOR", vector))
    scope: dict[str, Any] = {}
    exec(COUNTER.replace("VECTOR", "gym.vector.SyncVectorEnv([Counter])"), scope)
    env = scope["make_env"]()
    env.action_space.seed(3)
    actions = [env.action_space.sample() for _ in range(12)]
    (tmp_path / "actions.json").write_text(json.dumps([control.plain(one) for one in actions]))
    expected = [control.line(env.reset(seed=control.SEED)[0])]
    expected += [control.line(*env.step(one)[:4]) for one in actions]
    assert any(line.endswith("[1, 0]") for line in expected)
    words = [str(tmp_path), "env.py", str(tmp_path / "actions.json"), str(tmp_path / "found")]
    subprocess.run([sys.executable, control.__file__, *words], check=True, timeout=120)
    assert (tmp_path / "found").read_text().splitlines() == expected


def test_one_bit_is_a_difference() -> None:
    one = np.array([1.0, 2.0], np.float32)
    lines = [
        control.line(one),
        control.line(np.nextafter(one, 3, dtype=np.float32)),
        control.line(one.astype(np.float64)),
        control.line(one, np.nextafter(0.0, 1.0)),
        control.line(one, 0.0, True),
        control.line(one, 0.0, False, True),
    ]
    assert len(set(lines)) == len(lines)


def test_values_come_back_from_json() -> None:
    space = gym.spaces.Dict(
        {
            "box": gym.spaces.Box(-1, 1, (2, 3), np.float32),
            "pair": gym.spaces.Tuple((gym.spaces.Discrete(4), gym.spaces.Text(9))),
        }
    )
    for _ in range(5):
        sample = space.sample()
        back = control.restored(json.loads(json.dumps(control.plain(sample))))
        assert space.contains({**back, "pair": (np.int64(back["pair"][0]), back["pair"][1])})
        assert control.plain(back) == control.plain(sample)


def test_a_run_that_is_late_is_ended_with_all_that_it_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark = tmp_path / "mark"
    started = f"import subprocess, sys; subprocess.run(['sh', '-c', 'echo $$ > {mark}; sleep 600'])"
    trial = measure.Trial(Case("it", "package"), sys.executable, tmp_path, 0.0)
    # it is late as soon as it has started something, however long that takes
    under_way = lambda: mark.exists() and bool(mark.read_text().strip())  # noqa: E731
    monkeypatch.setattr(measure, "monotonic", lambda: float(eventually(under_way)))
    with pytest.raises(measure.Failed, match="deadline"):
        trial.run([sys.executable, "-c", started], {}, tmp_path)
    pid = mark.read_text().strip()
    limit = monotonic() + 60
    while Path(f"/proc/{pid}").exists() and ") Z " not in Path(f"/proc/{pid}/stat").read_text():
        assert monotonic() < limit
        sleep(0.05)
