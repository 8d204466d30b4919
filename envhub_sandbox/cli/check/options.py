"""Options of ``envhub check`` about a list, and which options may stand in the caller's file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from envhub_sandbox.cli.shared.exits import UsageError

SETTINGS = (
    *("steps", "resets", "slow_step", "seed", "fail_on", "allow", "policy", "n_envs"),
    *("timeout", "memory", "disk", "processes", "cpu_time"),
    *("jobs", "max_memory", "deadline"),
)
"""What may stand in ``[check]`` of ``--settings FILE``, by the names in Python."""
OF_A_LIST = ("output", "jobs", "max_memory", "again")
"""What means nothing for one repository; it may stand in a file that is for both."""
_PANEL = "A list"

File = Annotated[
    str | None,
    typer.Option(
        "--all",
        metavar="FILE",
        help="Judge a list of references, one per line; '-' is stdin.",
        rich_help_panel=_PANEL,
    ),
]
Output = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="With --all: the folder for reports and their index. A run continues there.",
        rich_help_panel=_PANEL,
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="With --all: repositories judged at once; by default one for every two cores.",
        rich_help_panel=_PANEL,
    ),
]
MaxMemory = Annotated[
    str | None,
    typer.Option(
        metavar="SIZE",
        help="With --all: sum of the memory limits of all jails at once; by default the free "
        "memory of this machine and its control groups.",
        rich_help_panel=_PANEL,
    ),
]
DEADLINE_S = 900.0
Deadline = Annotated[
    float,
    typer.Option(
        "--deadline",
        metavar="SECONDS",
        min=1,
        help="Time for one repository; after it the report names what was not judged.",
    ),
]
Again = Annotated[
    bool,
    typer.Option(
        "--again",
        help="With --all: judge also repositories that have results.",
        rich_help_panel=_PANEL,
    ),
]


def refuse_options_of_the_judged(
    places: Mapping[str, Path | None], reference: str, where: str = ""
) -> None:
    """No repository says how it is judged, and none holds what is found in it: refuse such places.
    Raises ``UsageError``: one lies in it.
    """
    from envhub_sandbox.check.settings import is_judged

    for option, path in places.items():
        if path is not None and is_judged(path, reference):
            raise UsageError(
                f"{option} {path} is inside the repository that is checked, {reference}{where}, "
                "and a repository must not influence its own check: take a place outside"
            )
