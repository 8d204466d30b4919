"""What ran (``provenance_of``), and how to make it again in another process (``Recipe``).

A process cannot be handed over, so a pickle of a proxy holds the arguments that made it. The other
side gets a fresh environment in a worker of its own, of the very same commit. A token never
travels, nor does a login in ``endpoint``: the other side uses its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from envhub_sandbox.hub.client import default_endpoint
from envhub_sandbox.hub.logins import without_login
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_worker.protocol.manifest.manifest import Manifest
from envhub_worker.protocol.messages import VERSION


@dataclass(frozen=True)
class PlainConfig:
    """What ``make_env`` takes in place of a caller's config object: what of it has crossed."""

    hub_path: str
    values: dict[str, object]


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """The arguments of ``make_env``, with the commit pinned.

    Attributes:
        make_env: The function that takes them; it travels by its name.
        reference: The pinned hub reference, or a local folder and its entry file.
        config: The caller's config object as plain values, or None.
    """

    make_env: Callable[..., Any]
    reference: str
    config: dict[str, object] | None = field(repr=False)
    options: dict[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        endpoint = self.options.get("endpoint")
        if isinstance(endpoint, str):
            plain = {**self.options, "endpoint": without_login(endpoint)}
            object.__setattr__(self, "options", plain)

    def make(self) -> Any:
        """Fresh environments: what ``make_env`` returns and raises."""
        cfg: Any = self.reference
        if self.config is not None:
            cfg = PlainConfig(self.reference, {**self.config, "hub_path": self.reference})
        options = dict(self.options)
        if options.get("endpoint") == without_login(default_endpoint()):
            options["endpoint"] = None  # it may come with a login here
        return self.make_env(cfg, **options)

    def make_one(self, suite: str, task: int | str) -> Any:
        """One fresh environment of them."""
        return self.make()[suite][task]


def provenance_of(
    snapshot: Snapshot,
    manifest: Manifest | None,
    report: list[dict[str, Any]],
    installed: dict[str, Any] | None = None,
    profile: str | None = None,
    places: Sequence[str] = (),
) -> dict[str, Any]:
    """What ran, as plain data: enough to run the same again, or to see that it cannot be the same.

    Args:
        snapshot: The files; every hash has been verified.
        manifest: What the worker said. Trust: interpreter and packages are its own words.
        report: The layers that confine it, once it runs.
        installed: What was installed for it: our own record.
        profile: Of its jails, once it runs.
        places: Where each worker of an environment runs, or is to run; results do not depend on it.
    """
    return {
        "repository": snapshot.repo_id,
        "repo_type": snapshot.repo_type,
        "commit": snapshot.commit,
        "path": snapshot.path,
        "files": {record.path: record.digest for record in snapshot.files},
        "interpreter": dict(manifest.interpreter) if manifest else None,
        "packages": dict(manifest.packages) if manifest else None,
        "assets": [one.pinned for one in snapshot.assets],
        "installed": installed,
        "protocol": VERSION,
        "profile": profile,
        "places": list(places),
        "layers": [dict(layer) for layer in report],
    }
