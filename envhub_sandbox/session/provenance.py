"""Says what ran: enough to run the same again, or to see that it cannot be the same."""

from __future__ import annotations

from typing import Any

from envhub_sandbox.hub.snapshot import Snapshot
from envhub_worker.protocol.manifest.manifest import Manifest
from envhub_worker.protocol.messages import VERSION


def provenance_of(
    snapshot: Snapshot,
    manifest: Manifest | None,
    report: list[dict[str, Any]],
    installed: dict[str, Any] | None = None,
    profile: str | None = None,
) -> dict[str, Any]:
    """The provenance of environments, as plain data.

    Args:
        snapshot: The files; every hash has been verified.
        manifest: What the worker said. Trust: interpreter and packages are its own words.
        report: The layers that confine it, once it runs.
        installed: What was installed for it: our own record.
        profile: Of its jails, once it runs.
    """
    return {
        "repository": snapshot.repo_id,
        "repo_type": snapshot.repo_type,
        "commit": snapshot.commit,
        "path": snapshot.path,
        "files": {record.path: record.digest for record in snapshot.files},
        "interpreter": dict(manifest.interpreter) if manifest else None,
        "packages": dict(manifest.packages) if manifest else None,
        "installed": installed,
        "protocol": VERSION,
        "profile": profile,
        "layers": [dict(layer) for layer in report],
    }
