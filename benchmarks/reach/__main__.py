"""How many repositories run in the sandbox that were not written for it.

Repositories around packages (``packages.toml``) and in different styles (``repositories``), each in
processes with a deadline and with caches of its own: by reference alone; if that fails, with one
argument; cold, again, and without a network; and the same repository in an ordinary environment,
stepped with the same actions and seeds. What was measured is kept in ``results.json``, where the
next run goes on. It needs an index, and downloads some gigabytes.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import uv

from benchmarks.reach import table
from benchmarks.reach.cases import HERE, Case, cases, removed
from benchmarks.reach.measure import EQUAL, UNSEEDED, Outcome, measured
from envhub_sandbox.dependencies import index

_RESULTS = HERE / "results.json"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what is missing, and print it; the exit code says whether all of it ran alone."""
    options = _parser().parse_args(arguments)
    known = _read(options.results)
    if options.write:
        table.write(known)
        return 0
    chosen = _chosen(options)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # what is temporary goes, too
    missing = {
        name
        for name, case in chosen.items()
        if options.again or name not in known or known[name].digest != case.digest
    }
    with _client(options.client, bool(missing)) as client:
        for name, case in chosen.items():
            if name in missing:
                known[name] = measured(case, client, options.deadline)
                _write(options.results, known)
            print(table.row(name, known[name]), flush=True)
    found = {name: known[name] for name in chosen}
    print("\n" + table.sums(found))
    return (
        0
        if all(not one.alone and one.control in (EQUAL, UNSEEDED) for one in found.values())
        else 1
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks reach", description=__doc__)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these, instead of all")
    parser.add_argument("--quick", action="store_true", help="the dozen that CI tries")
    parser.add_argument("--again", action="store_true", help="also what results.json has")
    parser.add_argument("--write", action="store_true", help="write the table into the documents")
    parser.add_argument("--results", type=Path, default=_RESULTS, help="where they are kept")
    parser.add_argument("--client", help="an interpreter that has envhub-sandbox and little else")
    parser.add_argument("--deadline", type=float, default=900.0, help="seconds of each")
    return parser


def _chosen(options: argparse.Namespace) -> dict[str, Case]:
    every = cases()
    if options.only:
        if unknown := [name for name in options.only if name not in every]:
            sys.exit(f"there is no {', '.join(unknown)}; there are {', '.join(every)}")
        return {name: every[name] for name in options.only}
    return {name: case for name, case in every.items() if case.quick or not options.quick}


@contextmanager
def _client(given: str | None, needed: bool) -> Iterator[str]:
    """An interpreter with this checkout, and with nothing that the cases need beyond Gymnasium."""
    if given or not needed:
        yield given or ""
        return
    folder = Path(tempfile.mkdtemp(prefix="envhub-reach-"))
    folder.chmod(0o755)
    python, program = str(folder / "bin/python"), uv.find_uv_bin()
    try:
        for words in (
            [program, "venv", "--quiet", "--python", sys.executable, "--clear", str(folder)],
            [program, "pip", "install", "--quiet", "--python", python, str(HERE.parents[1])],
        ):
            subprocess.run(words, check=True, env=index.environment())
        yield python
    finally:
        removed(folder)


def _read(path: Path) -> dict[str, Outcome]:
    if not path.exists():
        return {}
    found = json.loads(path.read_text())
    return {
        name: Outcome(**{**fields, "seconds": tuple(fields["seconds"])})
        for name, fields in found.items()
    }


def _write(path: Path, known: dict[str, Outcome]) -> None:
    draft = path.with_suffix(".draft")
    ordered = {name: asdict(known[name]) for name in [*cases(), *known] if name in known}
    draft.write_text(json.dumps(ordered, indent=1) + "\n")
    draft.replace(path)


if __name__ == "__main__":
    raise SystemExit(main())
