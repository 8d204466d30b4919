"""Which sub-environments of a fleet an error is of, and where they run."""

from __future__ import annotations

from envhub_sandbox.errors import EnvHubError, LocalProtocolError, RemoteEnvError
from envhub_sandbox.session.env_session import EnvSession


def rows_of(part: EnvSession) -> tuple[int, int]:
    """The first of its sub-environments, and the one after the last."""
    return part.bounds[0][0], part.bounds[-1][1]


def name_part(error: EnvHubError, part: EnvSession) -> None:
    """Add that to its text, once.

    An exception of the repository's own keeps its text, and what cannot be sent is the caller's.
    """
    if isinstance(error, (RemoteEnvError, LocalProtocolError)) or not error.args:
        return
    start, stop = rows_of(part)
    which = (
        f"sub-environment {start}"
        if stop == start + 1
        else (f"sub-environments {start} to {stop - 1}")
    )
    where = f"({which} of {part.manifest.num_envs}, on {part.lease.place})"
    if where not in str(error.args[0]):
        first, *rest = str(error.args[0]).split("\n")
        error.args = ("\n".join([f"{first} {where}", *rest]), *error.args[1:])
