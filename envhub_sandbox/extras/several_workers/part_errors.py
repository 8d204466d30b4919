"""Adds to an error of one worker which sub-environments it concerns, and where these run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from envhub_sandbox.errors import EnvHubError, LocalProtocolError, RemoteEnvError
from envhub_sandbox.session.env_session import EnvSession


@contextmanager
def naming(part: EnvSession) -> Iterator[None]:
    """Within this context, add to errors which sub-environments they concern."""
    try:
        yield
    except EnvHubError as error:
        name_in(part, error)
        raise


def name_in(part: EnvSession, error: EnvHubError) -> None:
    """Add a worker's rows and place to an error, unless repository or caller caused it."""
    if isinstance(error, (RemoteEnvError, LocalProtocolError)) or not error.args:
        return
    start, stop = part.rows
    alone = stop == start + 1
    rows = f"sub-environment {start}" if alone else f"sub-environments {start} to {stop - 1}"
    position = f"({rows} of {part.manifest.num_envs}, on {part.lease.place})"
    if position not in str(error.args[0]):
        first, *rest = str(error.args[0]).split("\n")
        error.args = ("\n".join([f"{first} {position}", *rest]), *error.args[1:])
