"""Every row of the fault table: what is seen, how soon, what remains, and who goes on."""

import contextlib
import gc
import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import Limits, Timeouts, errors, make_env
from tests.faults.conftest import Neighbour
from tests.faults.matrix.table import CLOSED, LOADING, RESET, ROWS, USABLE, Cell, Row, cells
from tests.faults.remains.traces import Traces
from tests.support import inside
from tests.support.processes import eventually, is_stopped
from tests.support.samples import sample

MIB = 1 << 20
_HANGS = ("hang", "stop")
_WAIT_S = 60.0
#: A generous bound on everything that must be noticed, and not be waited for.
BOUND_S = 120.0
_FULL = os.environ.get("ENVHUB_FAULTS") == "full"


@pytest.mark.parametrize("cell", [pytest.param(cell, id=cell.name) for cell in cells(_FULL)])
def test_fault_is_told_contained_and_cleaned_up(
    cell: Cell, neighbour: Neighbour, place: Path, tmp_path: Path
) -> None:
    """The user sees what the table says, in bounded time; siblings go on; nothing remains."""
    base = Traces.of(place)
    with contextlib.ExitStack() as stack:
        _try(cell, neighbour, _repository(cell.row, tmp_path), stack)
    gc.collect()
    assert eventually(lambda: not Traces.of(place).beyond(base)), Traces.of(place).beyond(base)


def _try(cell: Cell, neighbour: Neighbour, repository: Path, stack: contextlib.ExitStack) -> None:
    if cell.row.moment in LOADING:
        error, seconds = _caught(lambda: _use(_make(cell, repository)))
        suites = None
    else:
        suites = stack.enter_context(_make(cell, repository))
        error, seconds = _provoke(cell.row, suites)
    _check_what_is_seen(cell.row, error)
    assert seconds < BOUND_S
    assert neighbour.goes_on()
    if suites is not None:
        _check_what_becomes_of_it(cell, suites)


def _repository(row: Row, folder: Path) -> Path:
    if row.moment != "import":
        return sample("faulty")
    copied = Path(shutil.copytree(sample("faulty"), folder / "faulty"))
    (copied / "fault.json").write_text(json.dumps(row.fault))
    return copied


def _make(cell: Cell, repository: Path) -> Any:
    row = cell.row
    hangs = row.fault in _HANGS and row.moment in LOADING
    return make_env(
        repository,
        n_envs=2,
        use_async_envs=cell.mode == "async",
        num_workers=2 if cell.mode == "async" else None,
        env_kwargs={"moment": row.moment, "fault": row.fault, "tasks": 2 * (cell.mode == "suite")},
        policy={"restart": "on_reset", "lane": cell.lane},
        limits=_limits(row.fault),
        timeouts=Timeouts(
            startup_s=5.0 if hangs else _WAIT_S,
            reset_s=_WAIT_S,
            step_s=_WAIT_S,
            call_s=_WAIT_S,
            close_s=1.0,
        ),
    )


def _limits(fault: str) -> Limits:
    return Limits(
        memory_bytes=(512 if fault == "memory" else 4096) * MIB,
        disk_bytes=32 * MIB,
        cpu_time_s=1 if fault == "cpu" else None,
    )


def _use(suites: Any) -> Any:
    [tasks] = suites.values()
    first = next(iter(tasks.values()))
    try:
        first.reset()
    except errors.EnvHubError:
        suites.close()
        raise
    return suites


def _provoke(row: Row, suites: Any) -> tuple[Exception | None, float]:
    [tasks] = suites.values()
    env, *others = tasks.values()
    env.reset()
    env.step([0, 0])
    for other in others:
        other.reset()
        other.step([0, 0])
    if row.moment == "render":
        env.set_attr("armed", True)
    triggers: dict[str, Callable[[], Any]] = {
        "reset": lambda: env.reset(options={"now": True}),
        "step": lambda: env.step([0, 1]),
        "render": env.render,
        "call": lambda: env.call("trip"),
        "close": env.close,
    }
    if row.fault not in _HANGS:
        return _caught(triggers[row.moment])
    # what is asked before and after it is answered, however late a loaded machine does that
    with inside.hurried(env, reset_s=1.0, step_s=1.0, call_s=1.0):
        if row.fault == "stop" and row.moment == "step":
            return _caught(lambda: _step_that_stops(env))
        return _caught(triggers[row.moment])


def _step_that_stops(env: Any) -> Any:
    """Its time begins when somebody has been stopped: how that is told is what is asked here."""
    runners = inside.pids(env)
    inside.asks_patiently(env)
    env.step_async([0, 1])
    assert eventually(lambda: any(map(is_stopped, runners)))
    return env.step_wait()


def _caught(action: Callable[[], Any]) -> tuple[Exception | None, float]:
    started = time.monotonic()
    try:
        left = action()
    except errors.EnvHubError as error:
        return error, time.monotonic() - started
    seconds = time.monotonic() - started
    if hasattr(left, "close"):
        left.close()
    return None, seconds


def _check_what_is_seen(row: Row, error: Exception | None) -> None:
    if row.error is None:
        assert error is None
        return
    assert error is not None
    # a LoadError is also the builtin that was raised, and has a name of its own then
    assert row.error in [cls.__name__ for cls in type(error).__mro__], error
    for name, value in row.attributes.items():
        assert getattr(error, name) == value, name
    text = str(error)
    for part in ("faulty", "env.py", *row.says):
        assert part in text
    if row.error == "WorkerDiedError":
        assert f"about to {row.fault}" in text
        assert f"about to {row.fault}" in error.log_tail
        bundle = Path(error.bundle)
        assert f"about to {row.fault}" in (bundle / "README.txt").read_text()


def _check_what_becomes_of_it(cell: Cell, suites: Any) -> None:
    [tasks] = suites.values()
    env, *others = tasks.values()
    for other in others:  # its siblings in the suite never noticed
        assert other.step([0, 0])[0].tolist() == [[2.0], [2.0]]
    if cell.row.then == CLOSED:
        assert env.closed
        return
    if cell.row.then == RESET:
        with pytest.raises(errors.WorkerError, match=r"reset\(\)"):
            env.step([0, 0])
    elif cell.row.then == USABLE and cell.row.moment != "reset":
        assert env.step([0, 0])[0].shape == (2, 1)
    assert env.reset()[0].tolist() == [[0.0], [0.0]]
    assert env.step([0, 0])[0].tolist() == [[1.0], [1.0]]


def test_every_moment_and_fault_is_in_the_table() -> None:
    from tests.faults.matrix.table import FAULTS, MOMENTS

    assert {row.fault for row in ROWS} == set(FAULTS)
    assert {row.moment for row in ROWS} == set(MOMENTS)
