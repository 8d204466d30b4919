"""``docs/checks.md``, written from the table of checks, and that of settings.

Write it again with ``python -m tests.support.documents.checks``.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from pathlib import Path

from envhub_sandbox.check.checks import CHECKS
from envhub_sandbox.cli.check.options import SETTINGS
from tests.corpus.entries import Entry
from tests.corpus.faults import FAULTS
from tests.corpus.honest import HONEST

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "checks.md"
_HEAD = """# Checks

What `envhub check` asks of a repository, written from `envhub_sandbox/check/checks.py`. Its files
are read as data, its packages installed without running any of them, and each task is played with
seeded random actions in the sandbox: with every observation held against its space, once more in
fresh processes, again in these, with another seed, with other actions, and spread over two
processes. A play ends where it differs, if that is what is asked.

Exit code 0: nothing fails. 1: a finding weighs as much as `--fail-on` says (`error` by default),
and `--allow ID` does not permit it. 2: a wrong option. 10: nothing fails, but `--deadline SECONDS`
(15 minutes by default) ended it before all was judged. Others (see `envhub check --help`): it could
not be judged, because it could not be had, a server was full, or this host cannot confine it.

The deadline is for all of it: download, installation, reading and every play. Where it comes, the
report has what was found until then, and the check `deadline` says what was done at that time and
what was not judged: checks that were made of nothing, and tasks that were not played to their end.
JUnit has these as skipped, SARIF says that the run was not successful. The most severe findings
stand first in every form.

A check passes because a comparison of ours found nothing, never because the repository says so.
What is found in source is a hint for a person: who wants to hide a call can, and the walls are the
sandbox's. Files are parsed in a child whose time and memory
the kernel bounds; one that ends it is not read, and fails (`source-unparsed`). They are parsed from
their bytes, as Python does, and one whose first two lines choose another encoding than UTF-8 is not
decoded: it fails (`source-encoding`). So does compiled Python (`source-compiled`).

A folder is judged as its commit would be ([snapshots.md](snapshots.md#the-store)). Where git would
commit something else than what lies there, that fails (`source-uncommitted`). What it ignores is in
no commit, is not loaded and not pushed: it is named in a note (`source-ignored`).

Same seed, same episode, however often: that is asked twice, of fresh processes (`seeding`) and, if
these agree, of one process (`seed-ignored`), where Gymnasium's `check_env` asks it. So running
statistics and curricula that a reset does not reset fail it: leave them to the caller's wrappers.
An environment in which nothing is drawn by lot passes, with a note (`seed-constant`).

How long resets and steps take, and what the jail holds in the end, are figures of the report, for
they say as much of the machine; only steps that take a second, and resets that take five, are
findings (`--slow-step`). What resets leave behind is counted by the worker server, from outside of
the jail, after each of four rounds of `--resets`; what grows from each round to the next is a
finding, processes before threads, open files and memory.

A terminal shows what is done and for how long. In a log, whatever takes 10 seconds has a line, and
again after 20, 40 and so on.

The first process of the jail reports what the repository tried and was denied: the system call
filter asks it instead of refusing by itself (`Policy.record_denials`), with `sandbox="process"`
alone. What allocators and the C library try on their way is left out. Signals, priorities and the
like are reported when they name a process that is not the jail's own: one that lives outside of it,
or a number that no process in it can have had. A number that was in use before may have been a
child's, and is left out.

Limits are reported if they are used up when the worker server looks, from outside: after the plays
of a task. Processes that were refused are also counted by the jail's control group, where the
server may make one. What was filled and emptied again is not seen, nor what stays below.

That process sees each opening and change of a file by name, and lets the kernel decide. The finding
says that a path was asked for that is not the jail's own; it is read from the memory of the process
that asks, and no more is known. Reported are all attempts that would change something, connecting
or sending to a socket's file, and reading homes, secrets of the system and other processes
(libraries look for configurations in many other places). A link in its own folders is reported as
the place where it leads, up to sixteen folders down; another thread may have changed it since. Not
seen are: looking whether a file is there; changes by an open descriptor; a datagram that `sendmsg`
sends to a socket's file; under `no-userns` modes, owners and times, which seem to change. At most
32 paths are reported, and 64 attempts in all, also of a repository that does not load, and of one
whose process dies: the worker server learns of each attempt before the process goes on, and
remembers it until the jail is closed. Only the first play of each task is recorded.

`--policy FILE` is TOML with the fields of `Policy`, and a table `[limits]`. Where you judge often,
`--settings envhub.toml` has options in `[check]`:

SETTINGS

What you type counts more, and what is about a list (`--all`) means nothing for one repository.
Both files are yours: they are named, and never looked for, and one that lies in what is judged is
refused.

Each report but JUnit's and SARIF's says which profile its jails had, which layers did not hold and
why, and why what it tried was not recorded, where a kernel or a container refuses that. No profile
but the one that you name, or `strict`, is ever taken: where this host cannot enforce it, nothing is
judged (exit code 6), and the error says what is missing and what to do.

`--json` prints everything; `--junit FILE` has one test case for each check of each task, `--sarif
FILE` is SARIF 2.1.0, and `--github` prints annotations and appends to `$GITHUB_STEP_SUMMARY`.
`--all FILE` judges a list, every night: see [ci.md](ci.md#every-night).

`--html FILE` is one page that needs nothing else and runs no script. It has the findings and, of
each task, rendered frames, a film of some seconds (with the extra `video`), the returns and lengths
of episodes, how long steps took, the memory of the jail, and its spaces; then how it was judged and
what ran, file by file. Pictures, film and plots are made by the client, of numbers that it has
checked; no bytes of a repository's stand in the page, and its texts are text there. The first
twelve tasks are filmed, each for some two seconds, once all has been asked: whether somebody looks
changes no verdict.

| Check | Severity | What holds where it passes | What cures it |
| --- | --- | --- | --- |
"""

_CORPUS = """
## How good it is

`tests/corpus` has repositories that are judged in each test run: honest ones in many styles, in
which nothing but notes may be found, and others with one fault each, which its check has to find
and no other check may. Missed is a fault that is not found; false is a finding where there is none.
`python -m tests.corpus` prints what is found in each.

| Repositories | Number | Right | Missed | False |
| --- | --- | --- | --- | --- |
"""


def document() -> str:
    """What the file has to hold."""
    rows = [
        f"| `{check.id}` | {check.severity.value} | {check.sentence} | {check.cure} |"
        for check in CHECKS.values()
    ]
    options = ", ".join(f"`{name.replace('_', '-')}`" for name in SETTINGS)
    head = _HEAD.replace("SETTINGS", textwrap.fill(f"{options}.", 100, break_on_hyphens=False))
    return head + "\n".join(rows) + "\n" + _CORPUS + "\n".join(_judged()) + "\n"


def _judged() -> Iterator[str]:
    """A row for each group of the corpus, and one for all of it; its tests judge every entry."""
    groups: dict[str, list[Entry]] = {}
    for entry in (*HONEST.values(), *FAULTS.values()):
        groups.setdefault(entry.group, []).append(entry)
    for name, entries in {**groups, "all": [*HONEST.values(), *FAULTS.values()]}.items():
        missed = sum(bool(entry.right - entry.expected) for entry in entries)
        false = sum(bool(entry.expected - entry.right) for entry in entries)
        right = sum(entry.expected == entry.right for entry in entries)
        yield f"| {name} | {len(entries)} | {right} | {missed} | {false} |"
    for name, entry in {**HONEST, **FAULTS}.items():
        if entry.expected != entry.right:
            yield f"\nNot right is “{name}”: {entry.why}"


if __name__ == "__main__":
    DOCUMENT.write_text(document())
