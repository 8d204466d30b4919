"""Reports: JSON with every turn, and tables in Markdown."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.peers import PEERS
from benchmarks.targets import OTHERS
from benchmarks.workloads import WORKLOADS


def write_report(results: dict[str, Any], folder: Path) -> list[Path]:
    """Write ``<start>.json`` and ``<start>.md``; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    stem = results["started"].replace(":", "")[:17]
    data, text = folder / f"{stem}.json", folder / f"{stem}.md"
    data.write_text(json.dumps(results, indent=1) + "\n")
    text.write_text("\n".join(markdown(results)) + "\n")
    return [data, text]


def markdown(results: dict[str, Any]) -> Iterator[str]:
    """The whole report."""
    facts = ", ".join(f"{name} {value}" for name, value in results["machine"].items())
    yield f"# Benchmarks, {results['started']}"
    yield ""
    yield f"{facts}. Load before the start: {results['load_average']:.2f}."
    yield f"{results['rounds']} rounds of {results['seconds']} s for each peer."
    yield ""
    yield from _targets(results)
    yield "## Steps"
    yield ""
    for cell in results["steps"]:
        yield from cell_lines(cell)


def _targets(results: dict[str, Any]) -> Iterator[str]:
    if not results.get("targets"):
        return
    yield "## Targets on two cores"
    yield ""
    yield "| workload, condition | n | envhub | x Sync, target | x Async, target | reached |"
    yield "|---|---|---|---|---|---|"
    for row in results["targets"]:
        yield _target_row(row)
    yield ""
    for name, ratio in results["against_others"].items():
        title = PEERS[name].title
        yield f"CartPole, n = 16, quiet: {ratio:.2f} x {title} (target {OTHERS[name]:g})."
    yield ""


def _target_row(row: dict[str, Any]) -> str:
    found, target = row["found"], row["target"]
    sync = f"{found['sync']:.2f}, {_or_none(target['sync'])}"
    if target["over_us"] is not None:
        sync = f"{found['over_us']:.0f} us over, at most {target['over_us']:.0f}"
    return (
        f"| {WORKLOADS[row['workload']].title}, {row['condition']} | {row['n']} "
        f"| {PEERS[row['peer']].title} | {sync} "
        f"| {found['async']:.2f}, {_or_none(target['async'])} "
        f"| {'yes' if row['reached'] else '**no**'} |"
    )


def _or_none(value: float | None) -> str:
    return "none" if value is None else f"{value:g}"


def cell_lines(cell: dict[str, Any]) -> Iterator[str]:
    """One workload at one size under one condition."""
    others = cell["busy_cores_before_rounds"]
    busy = f"{min(others):.2f} to {max(others):.2f}"
    yield f"### {WORKLOADS[cell['workload']].title}, n = {cell['n']}, {cell['condition']}"
    yield ""
    yield f"Cores in use by others before the rounds: {busy}. Microseconds for one vector step."
    yield ""
    yield "| peer | mean | p50 | p95 | over Sync | x Sync | x Async | p50: x Sync | x Async |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for name, result in cell["peers"].items():
        yield _row(PEERS[name].title + _setting(cell["ready"][name]), result)
    yield ""
    yield from _not_measured({**cell["absent"], **cell["failed"]})
    yield from _digests(cell)


def _setting(ready: dict[str, Any]) -> str:
    setting = ", ".join(f"{name}={value}" for name, value in ready["setting"].items())
    return f" ({setting})" if setting else ""


def _row(title: str, result: dict[str, Any]) -> str:
    numbers = [result["step_us"], result["p50_us"], result["p95_us"], result.get("over_sync_us")]
    cells = ["" if number is None else f"{number:.0f}" for number in numbers]
    cells += [_ratio(result.get(key)) for key in ("x_sync", "x_async")]
    cells += [_median(result.get(key)) for key in ("p50_x_sync", "p50_x_async")]
    return f"| {title} | " + " | ".join(cells) + " |"


def _ratio(ratio: dict[str, Any] | None) -> str:
    if ratio is None:
        return ""
    low, high = ratio["quartiles"]
    return f"**{ratio['median']:.2f}** ({low:.2f}-{high:.2f})"


def _median(ratio: dict[str, Any] | None) -> str:
    return "" if ratio is None else f"{ratio['median']:.2f}"


def _not_measured(reasons: dict[str, str]) -> Iterator[str]:
    for name, reason in reasons.items():
        yield f"Not measured: {PEERS[name].title} ({reason})."
        yield ""


def _digests(cell: dict[str, Any]) -> Iterator[str]:
    found = {name: ready["digest"] for name, ready in cell["ready"].items() if ready["digest"]}
    if len(set(found.values())) > 1:
        yield f"**Results differ**: {found}"
        yield ""
