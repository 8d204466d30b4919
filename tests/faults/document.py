"""Writes ``docs/faults.md`` from the table: ``python -m tests.faults.document``.

The seconds are the median cell of a row in one full run, kept in ``measured.json``.
"""

from __future__ import annotations

import json
from pathlib import Path

from tests.faults.table import FAULTS, MOMENTS, ROWS, Row

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "faults.md"
_MEASURED = Path(__file__).with_name("measured.json")

_HEAD = """\
# When things go wrong

This file is written from the table in `tests/faults/table.py` by `python -m tests.faults.document`.
`tests/faults/test_matrix.py` tries the rows; with `ENVHUB_FAULTS=full` it tries each of them in a
`SyncVectorEnv`, in an `AsyncVectorEnv` of two shards and in a suite of two tasks, over the fast
lane and over frames. Without it one combination of each row runs, and all endings of a step.

In every cell:

- The error's text names the repository, commit and entry file. `WorkerDiedError` carries the exit
  code or signal, the reason, the request and the last lines of output; `WorkerTimeoutError` the
  request and the timeout. Both have them as attributes.
- Another environment of the same client, and the other tasks of a suite, go on undisturbed.
- After `close()` no process, zombie, descriptor, mapped slab, socket, file, mount or control group
  is there that was not there before. This is read from `/proc` and the file system.

"In seconds" is the median of a row's six cells, on two busy cores, from the request to the error
or the answer. Timeouts were 1 second for requests, 5 for starting and 1 for closing. `reset()`
after a death needs `policy={"restart": "on_reset"}`; after a timeout it needs nothing.

## However the client ends

`tests/faults/test_nothing_left.py` ends clients: by return without `close()`, exceptions,
`sys.exit`, `os._exit`, a crash, and by SIGINT, SIGTERM, SIGHUP and SIGKILL while idle, in a step
and in `make_env`. Nothing of theirs remains, their temporary folders included. (If the *server* is
killed its client removes the folder; if both are killed at once, a folder and empty control groups
stay.)

- **Ctrl-C in a step** comes at once. The reply is then late: a step says so, `reset()` recovers.
- **A fork of the client** refuses its parent's environments with a `WorkerError` and may make its
  own. Whatever it does, the parent's go on; its end ends nothing of theirs.
- **`close()` from another thread, or from a signal handler**, ends a running step or a start with
  Gymnasium's `ClosedEnvironmentError`.
- **A proxy that nobody holds** any more ends its processes when it is collected.

## The rows

| The repository's code | when | you see | in seconds | then the environment |
|---|---|---|---|---|
"""


def document() -> str:
    """The file's text."""
    measured = json.loads(_MEASURED.read_text())
    return _HEAD + "".join(f"{_line(row, measured)}\n" for row in ROWS)


def _line(row: Row, measured: dict[str, float]) -> str:
    seconds = measured[row.name]
    shown = "under 0.1" if seconds < 0.1 else f"{seconds:.1f}"
    cells = (FAULTS[row.fault], MOMENTS[row.moment], _seen(row), shown, row.then)
    return f"| {' | '.join(cells)} |"


def _seen(row: Row) -> str:
    if row.error is None:
        return "nothing"
    found = {name: value for name, value in row.attributes.items() if value is not None}
    details = ", ".join(f"{name}={value!r}" for name, value in found.items())
    return f"`{row.error}`" + (f": `{details}`" if details else "")


if __name__ == "__main__":
    DOCUMENT.write_text(document())
