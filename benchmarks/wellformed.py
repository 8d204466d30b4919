"""Whether a report says what it should. Never whether anything was fast."""

from __future__ import annotations

from typing import Any

from benchmarks.peers import ASYNC, SYNC
from benchmarks.plan import Plan


def problems(results: dict[str, Any], plan: Plan) -> list[str]:
    """What is missing or failed; empty if all is well.

    Peers that are not installed are no problem; ours and Gymnasium's are always there.
    """
    wanted = [name for name in plan.peers if name in (SYNC, ASYNC, "envhub", "envhub-frames")]
    cells, expected = results["steps"], len(plan.cells) * len(plan.conditions)
    found = [] if len(cells) == expected else [f"{len(cells)} cells instead of {expected}"]
    for cell in cells:
        where = f"{cell['workload']}, n = {cell['n']}, {cell['condition']}"
        reasons = {**cell["absent"], **cell["failed"]}
        for name in wanted:
            result = cell["peers"].get(name)
            if result is None or not result["step_us"] > 0:
                found.append(f"{where}, {name}: {reasons.get(name, 'no result')}")
        digests = {ready["digest"] for ready in cell["ready"].values() if ready["digest"]}
        if len(digests) != 1:
            found.append(f"{where}: results differ between peers")
    return found
