"""Lies made from what real workers have said: a bounded number here, longer by ``tests.fuzz``.
The seed here is the same each time, so that who changes nothing breaks nothing. New lies are told
by the command, which draws a seed and prints it. What fails says how to do it again."""

import pickle
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from envhub_sandbox.hub.listing import Snapshot
from envhub_sandbox.transport import results, values
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.limits import WireLimits
from envhub_worker.protocol.messages import message
from tests.fuzz import child, traffic
from tests.fuzz.oracle import WrongError, fits
from tests.support import inside

ROOT = Path(__file__).parents[3]
EXAMPLES = 100
SEED = 1
MANY = 300
KINDS = {
    *("LoadDone", "BuildDone", "ResetDone", "StepDone", "Value", "RaisedException"),
    *("RelayDone", "JailOpened"),
}


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("traffic") / "recording"
    run = [sys.executable, "-m", traffic.__name__, str(file)]
    subprocess.run(run, cwd=ROOT, check=True, timeout=280)
    return file


def fuzz(corpus: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tests.fuzz", "--corpus", corpus, *arguments]
    return subprocess.run(
        list(map(str, command)), cwd=ROOT, capture_output=True, text=True, check=False, timeout=280
    )


def test_the_recording_has_every_kind(corpus: Path) -> None:
    """What is spoiled was said by real workers, in all the ways in which they say it."""
    messages = child.decoded(pickle.loads(corpus.read_bytes()))
    assert {type(message).__name__ for message in messages} >= KINDS


def test_lies_are_taken_rightly_or_refused(corpus: Path) -> None:
    """Nothing comes out but right values and errors of ours, in bounded memory and time."""
    run = fuzz(corpus, "--examples", EXAMPLES, "--seed", SEED)
    print(run.stdout)
    assert run.returncode == 0, run.stdout + run.stderr
    lines = [line for line in run.stdout.splitlines() if " lies: " in line]
    assert [line.split()[0] for line in lines] == list(child.ALL)
    assert all(line.split()[1] == str(EXAMPLES) and " taken" in line for line in lines), lines


@pytest.mark.parametrize(
    "says",
    [
        {
            "control_raises": "KeyError",
            "control_harms": "this is a control",
            "control_eats": "MemoryError",
        },
        {"control_hangs": "SIGALRM"},
        {"control_dies": "SIGSEGV"},
    ],
    ids="-".join,
)
def test_whatever_must_not_come_out_is_noticed(corpus: Path, says: dict[str, str]) -> None:
    """The controls: each way of going wrong ends in a failure that names the lie and the seed."""
    # who is short of patience takes a machine that stands still for one that hangs
    patience = 5 if "control_hangs" in says else 60
    run = fuzz(corpus, "--examples", 1, "--seed", 7, "--patience", patience, *says)
    assert run.returncode == 1
    for control, word in says.items():
        assert word in run.stdout
        assert f"{control} " in run.stdout
    assert "seed 7" in run.stdout


Recorded = tuple[list[traffic.Frames], list[m.Message]]


@pytest.fixture(scope="module")
def recorded(corpus: Path) -> Recorded:
    found: list[traffic.Frames] = pickle.loads(corpus.read_bytes())
    return found, child.decoded(found)


def first_wrong(recorded: Recorded, target: str) -> str:
    """What the first lie that does harm does, or nothing."""
    for number in range(MANY):
        try:
            child.lie(target, number, 1, *recorded)
        except WrongError as error:
            return str(error)
        except Exception:
            continue
    return ""


class Forgetful:
    """In the place of what reads a document that is known: it has lost the fields."""

    def __init__(
        self, document: bytes, tail: Any, buffers: Any, make: type[m.Message], limits: WireLimits
    ) -> None:
        self.limits, self.make = limits, make

    def message(self, *_: object, **__: object) -> m.Message:
        return self.make(*[None] * len(self.make.FIELDS))


_NAIVE = {"id": "A-v0", "entry_point": "os:system"}
UNCHECKED: dict[str, tuple[tuple[object, str, object], str]] = {
    "results": ((results.batches, "conforms", lambda *_: True), "where|another mapping"),
    "unpack": ((message, "Incoming", Forgetful), "another message"),
    "things": ((values, "spec_of", lambda facts: EnvSpec(**_NAIVE)), "an entry point"),
    "tracebacks": ((Snapshot, "known_as", lambda self, path: f'"{path}"'), "another file"),
    "warnings": ((*inside.CHECK_OF_WARNINGS, lambda one: one), "a giant|no text"),
}


@pytest.mark.parametrize("target", UNCHECKED)
def test_what_is_not_checked_is_noticed(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch, target: str
) -> None:
    """Without one check of the client's the fuzzer says so; with it, nothing."""
    assert first_wrong(recorded, target) == ""
    without, says = UNCHECKED[target]
    monkeypatch.setattr(*inside.FORMS, message.Forms())
    monkeypatch.setattr(*without)
    assert re.search(says, first_wrong(recorded, target))


SPACE = spaces.Dict({"x": spaces.Box(-1, 1, (2,)), "t": spaces.Tuple([spaces.Discrete(3)])})
GOOD: dict[str, Any] = {"t": (np.zeros(3, np.int64),), "x": np.zeros((3, 2), np.float32)}
MISFITS: dict[str, dict[str, Any]] = {
    "shape": {"x": np.zeros((3, 3), np.float32)},
    "dtype": {"x": np.zeros((3, 2))},
    "count": {"t": (np.zeros(2, np.int64),)},
    "kind": {"t": [np.zeros(3, np.int64)]},
    "list": {"x": [[0.0, 0.0]] * 3},
    "read-only": {"x": np.broadcast_to(np.float32(0), (3, 2))},
    "key": {"y": None},
}


@pytest.mark.parametrize("what", list(MISFITS))
def test_a_misfit_is_seen_by_the_judge(what: str) -> None:
    fits(SPACE, GOOD, 3)
    with pytest.raises(WrongError):
        fits(SPACE, {**GOOD, **MISFITS[what]}, 3)
