"""The fault matrix: what goes wrong, when, and what the user is then promised to see.
``test_matrix.py`` tries every row; ``docs/faults.md`` explains what to do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

MODES = ("sync", "async", "suite")
"""``SyncVectorEnv`` in one process; ``AsyncVectorEnv`` in two shards; one of a suite's tasks."""
LANES = ("auto", "frames")
FAULTS = {
    "missing": "imports a package that is not there",
    "raise": "raises `ValueError`",
    "recursion": "recurses without end",
    "disk": "fills its disk",
    "hang": "never returns",
    "stop": "is stopped (`SIGSTOP`)",
    "exit": "calls `os._exit(7)`",
    "sys.exit": "calls `sys.exit(8)`",
    "kill": "gets `SIGKILL`",
    "segfault": "crashes (`SIGSEGV`)",
    "memory": "allocates without end",
    "cpu": "spins, under `Limits(cpu_time_s=1)`",
    "flood": "prints 10 MB",
    "thread": "starts a thread that never ends",
    "atexit": "registers an exit handler that hangs",
    "children": "leaves daemons, deaf to `SIGTERM`",
}
MOMENTS = {
    "import": "while being imported",
    "make": "in `make_env`",
    "init": "in a sub-environment's constructor",
    "reset": "in `reset`",
    "step": "in `step`",
    "render": "in `render`",
    "call": "in a method called by `call`",
    "close": "in `close`",
}
LOADING = ("import", "make", "init")
USABLE = "goes on at once"
RESET = "`reset()` brings it back"
AGAIN = "make it again"
CLOSED = "is closed, as asked"


@dataclass(frozen=True, kw_only=True)
class Row:
    """One fault at one moment.

    Attributes:
        fault, moment: Keys of ``FAULTS`` and ``MOMENTS``.
        error: The exception's class, or None where nothing is raised.
        attributes: What it carries.
        says: Parts of its text, beside the repository's name.
        then: What becomes of the environment.
    """

    fault: str
    moment: str
    error: str | None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    says: Sequence[str] = ()
    then: str

    @property
    def name(self) -> str:
        return f"{self.fault}-{self.moment}"


def _rows() -> list[Row]:
    moments = [moment for moment in MOMENTS if moment != "close"]
    rows = [_row("missing", "import")]
    rows += [_row(fault, at) for fault in ("raise", "hang", "exit", "kill") for at in moments]
    rows += [_row(fault, at) for fault in ("sys.exit", "memory") for at in ("make", "step")]
    rows += [_row(fault, "step") for fault in ("recursion", "disk", "stop", "segfault", "cpu")]
    unnoticed = ("flood", "thread", "atexit", "children")
    rows += [_row(fault, at) for fault in unnoticed for at in ("import", "step")]
    closing = ("raise", "hang", "exit", "kill", "stop", "memory", "children")
    return rows + [Row(fault=one, moment="close", error=None, then=CLOSED) for one in closing]


def _row(fault: str, moment: str) -> Row:
    what = _SEEN[fault](moment) if fault in _SEEN else {"error": None, "then": USABLE}
    if moment in LOADING and what["error"] is not None:
        what["then"] = AGAIN
    return Row(fault=fault, moment=moment, **what)


def _raised(builtin: str, text: str) -> Any:
    def seen(moment: str) -> dict[str, Any]:
        loading = moment in ("import", "make")
        error = "LoadError" if loading else f"Remote{builtin}"
        attributes = {} if loading else {"type_name": builtin}
        return {"error": error, "attributes": attributes, "says": (text,), "then": USABLE}

    return seen


def _died(says: str, **attributes: Any) -> Any:
    def seen(moment: str) -> dict[str, Any]:
        request = "make_env" if moment in LOADING else moment
        found = {"exit_code": None, "signal": None, **attributes, "request": request}
        text = (f"died during {request}", says)
        return {"error": "WorkerDiedError", "attributes": found, "says": text, "then": RESET}

    return seen


def _late(moment: str) -> dict[str, Any]:
    request = "make_env" if moment in LOADING else moment
    return {
        "error": "WorkerTimeoutError",
        "attributes": {"request": request},
        "says": (f"{request} has not finished after",),
        "then": RESET,
    }


def _frozen(moment: str) -> dict[str, Any]:
    seen = _late(moment)
    return {**seen, "says": (*seen["says"], "stopped")}


def _exits(moment: str) -> dict[str, Any]:
    seen = _raised("SystemExit", "8")(moment)
    return seen if moment in ("import", "make") else {**seen, "error": "RemoteEnvError"}


_SEEN: dict[str, Any] = {
    "missing": lambda moment: {
        "error": "DependencyError",
        "says": ("no_such_package_of_ours",),
        "then": AGAIN,
    },
    "raise": _raised("ValueError", "no luck today"),
    "recursion": _raised("RecursionError", "recursion"),
    "disk": _raised("OSError", "No space left on device"),
    "sys.exit": _exits,
    "hang": _late,
    "stop": _frozen,
    "exit": _died("exit code 7", exit_code=7, reason="exit"),
    "kill": _died("SIGKILL", signal="SIGKILL", reason="signal"),
    "segfault": _died("SIGSEGV", signal="SIGSEGV", reason="signal"),
    "memory": _died("out of memory", signal="SIGKILL", reason="out-of-memory"),
    "cpu": _died("cpu limit", signal="SIGXCPU", reason="cpu-limit"),
}
ROWS = tuple(_rows())


@dataclass(frozen=True)
class Cell:
    """A row, in one kind of vector environment, over one lane."""

    row: Row
    mode: str
    lane: str

    @property
    def name(self) -> str:
        return f"{self.row.name}-{self.mode}-{self.lane}"


def cells(full: bool) -> list[Cell]:
    """All cells, or one of each row, so that every mode and lane has its turn."""
    pairs = [(mode, lane) for lane in LANES for mode in MODES]
    if full:
        return [Cell(row, mode, lane) for row in ROWS for mode, lane in pairs]
    chosen = [Cell(row, *pairs[index % len(pairs)]) for index, row in enumerate(ROWS)]
    # what the fast lane has to notice by itself: every way not to answer a step, in both shapes
    fast = [row for row in ROWS if row.moment == "step" and row.then == RESET]
    chosen += [Cell(row, mode, "auto") for row in fast for mode in ("sync", "async")]
    return list({cell.name: cell for cell in chosen}.values())
