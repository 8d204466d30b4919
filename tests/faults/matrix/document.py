"""Writes ``docs/faults.md`` from the table: ``python -m tests.faults.matrix.document``.

The seconds are the median cell of a row in one full run, kept in ``measured.json``.
"""

from __future__ import annotations

import json
from pathlib import Path

from tests.faults.matrix.table import FAULTS, MOMENTS, ROWS, Row

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "faults.md"
_MEASURED = Path(__file__).with_name("measured.json")

_HEAD = """\
# When things go wrong

This file is written from the table in `tests/faults/matrix/table.py` by
`python -m tests.faults.matrix.document`. `tests/faults/matrix/test_matrix.py` tries the rows; with
`ENVHUB_FAULTS=full` it tries each of them in a
`SyncVectorEnv`, in an `AsyncVectorEnv` of two shards and in a suite of two tasks, over the fast
lane and over frames. Without it one combination of each row runs, and all endings of a step.

In every cell:

- The error's text names the repository, commit and entry file. `WorkerDiedError` carries the exit
  code or signal, the reason, the request and the last lines of output; `WorkerTimeoutError` the
  request and the timeout. Both have them as attributes; and, like `LoadError`, `denied`: what was
  tried in the jail that it ended, where the policy has `record_denials`. A death leaves a
  [crash bundle](crashes.md), with which `envhub replay` does the same again.
- Another environment of the same client, and the other tasks of a suite, go on undisturbed.
- After `close()` no process, zombie, descriptor, mapped slab, socket, file, mount or control group
  of a jail is there that was not there before. This is read from `/proc` and the file system. The
  worker server lingers (see below). Where other tasks of a suite are open yet, `close()` has
  asked for the end of its jail and does not wait for it: whoever closes the next one does, and the
  last.

"In seconds" is the median of a row's six cells, on two busy cores, from the request to the error
or the answer. Timeouts were 1 second for requests, 5 for starting and 1 for closing. `reset()`
after a death needs `policy={"restart": "on_reset"}`; after a timeout it needs nothing.

## Deaths that are survived

`policy={"restart": "transparent"}` brings back what has died, in the middle of a step or a reset.
Only the sub-environments of the process that died come back, in a fresh process of the same jail;
the others go on, and their rows are their real results. `tests/faults/test_transparent.py` has a
test for each sentence here.

- **In a step** the rows of the dead have the observation of a fresh reset, reward 0, terminated
  False and truncated True; the infos have `worker_restarted` for them, with its mask
  `_worker_restarted`. What they did since the last observation is lost with them, and so is the
  final observation of their episode: mask these rows where a final observation is learnt from.
- **Afterwards** they are as after any truncation in their autoreset mode. *NEXT_STEP*: the next
  action is not looked at, that step resets them (again). *SAME_STEP*: they are in the next episode,
  of which the observation is the first; it stands in `final_obs` too, and `final_info` is empty.
  *DISABLED*: a step before their `reset` is refused as Gymnasium refuses it. An environment with a
  `step` of its own comes back as a whole: it is reset, and its next step is a step.
- **In a reset** the fresh process is asked for the same reset with the same seeds, once, and the
  infos have `worker_restarted`. A reset with a mask also brings back those rows of the dead
  process that the mask does not name: their episodes begin anew.
- **In a `call`, `get_attr`, `set_attr` or `render`** nothing is repeated, for nobody knows how far
  it came: it raises `WorkerDiedError`, and so do others until a step (which then reports the rows
  as above) or a reset has brought them back. A death between two requests is met by the next.
- **Attributes** that `set_attr` had set everywhere are set again, as they were sent, the last value
  of each, before anything else is asked; one whose setter raises there is left out, and the log
  says so. What calls had changed is lost. A fresh jail after a timeout, an expiry or a death that
  was told has neither.
- **Seeds**: whoever was last seeded with `s` comes back with
  `int(np.random.SeedSequence((abs(s), n)).generate_state(1)[0])` at the environment's `n`-th
  restart, so that a seeded run with the same deaths is the same run. Whoever was never seeded
  draws a seed.
- **Who dies**: an exit, a signal, a crash or the cpu limit takes one process. The memory limit is
  the jail's: where the kernel does not say whom it ended for it, all processes end and all rows
  come back. The jail's own end, or the server's, takes all rows, and they come back in another
  jail. A suite that `make_env` has built at once shares one process: a death there is everybody's,
  and each environment is told at its own next request.
- **How long**: the step waits for the others as long as `step_s` says; starting and resetting have
  `startup_s` and `reset_s` for themselves. A timeout stays a `WorkerTimeoutError`, and `reset()`
  recovers, also if somebody has died meanwhile.
- **How often**: `restart_budget` and `restart_backoff_s` count every time that a step or a reset
  had to bring something back. When they are used up, or when what is coming back dies again or
  cannot be built, the error says how, and the environment is dead: the next `reset()` starts afresh
  if the budget allows. A process that breaks the rules of the wire is not brought back.
- **What stays**: the fresh process has slabs and a stream that the dead one never saw. Its children
  are ended with it; daemons that have left its session end with the jail, and until then count
  towards its limits. Shards of one environment are one repository's code in one jail: they are not
  protected from each other's writes to the batch of results that they share.

Whatever is asked of a timed out, dead or restarted environment, no answer is taken for another's:
`tests/faults/test_attribution.py` drives it through random sequences of all these, and
`benchmarks/soak.py` through a million steps beside an oracle.

## Time without work

With `timeouts={"idle_s": 60}` the processes of an environment of which nothing is asked for a
minute (and up to two seconds more: the server looks once a second) are ended, and their memory is
given back. That is no death: no policy is asked and no budget spent. The next `reset()` starts
others; a step or a call before it raises a `WorkerDiedError` with `reason="idle"` that says so.
Each task of a suite has its own clock, unless `make_env` has built them all at once. Whoever owes
an answer is not idle.

## However the client ends

**After the last `close()`** the worker server, or the container, is kept for the next environment,
for `timeouts={"server_idle_s": 30}` seconds; 0 ends it at once. It holds no jail, and nothing that
has executed a repository's code: one server at most, and a warm interpreter for each kind of policy
that was used last, at most three (a server and one of these are three processes, whose own memory
was 60 MB when this was written). It ends with the client at the latest, however that ends;
`tests/integration/test_lingering.py` looks from outside.

`tests/faults/remains/test_nothing_left.py` ends clients: by return without `close()`, exceptions,
`sys.exit`, `os._exit`, a crash, and by SIGINT, SIGTERM, SIGHUP and SIGKILL while idle, in a step
and in `make_env`; `tests/faults/remains/test_starting.py` while their server starts, at moments
that it waits for, and `python -m tests.faults.remains.starts --rounds 200` at random ones. Nothing
of theirs remains, their temporary folders included. (If the *server* is killed its client removes
the folder.
If both are killed at once, or a client that has no server yet, a folder and empty control groups
stay. The folder says whose it was: the next server that this user starts removes it, and
`envhub gc` both.)

- **Ctrl-C in a step** comes at once. The reply is then late: the next step (a notebook's next cell)
  says what was interrupted, `reset()` recovers.
- **Ctrl-C in a close** may leave something to do. The next `close()` goes on with it, or the end
  of the object: no process, no descriptor and no use of the server remains.
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
