"""``envhub init``: a new environment's repository, which loads and steps as it is."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Annotated

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import out, safe_line, say
from envhub_sandbox.cli.shared.exits import UsageError
from envhub_sandbox.cli.starter import starter
from envhub_sandbox.hub.git.checkout import make_checkout

_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,94}[A-Za-z0-9])?", re.ASCII)


@opt.with_options()
def init(
    folder: Annotated[
        Path,
        typer.Argument(metavar="NAME", help="The new folder; its last part names the repository."),
    ],
    lerobot: Annotated[
        bool,
        typer.Option(
            "--lerobot",
            help="Write an environment that LeRobot can evaluate and train on, with agent_pos and "
            "pixels as observations.",
        ),
    ] = False,
) -> None:
    """Write a new environment's repository: env.py, requirements, card, licence, test, CI workflow.

    If git is installed and the folder is in no checkout, 'git init' runs in it.

    [bold]envhub init my-env && envhub run ./my-env --validate[/bold]
    """
    name = repository_name(folder)
    _write(folder, starter(name, time.localtime().tm_year, lerobot=lerobot))
    make_checkout(folder)
    shown = safe_line(str(folder) if folder.is_absolute() else f"./{folder}")
    out(shown)
    say(f"Try it: envhub run {shown} --validate. Publish it: envhub push {shown} OWNER/{name}")


def repository_name(folder: Path) -> str:
    """The name that a folder gives to its repository. Raises ``UsageError``."""
    name = folder.absolute().name
    if not _NAME.fullmatch(name) or "--" in name or ".." in name or name.endswith(".git"):
        raise UsageError(
            f"{name!r} is not a valid name on the Hub: use letters, digits, '-', '_' and '.', with "
            "a letter or digit at both ends, and no '--' or '..'"
        )
    return name


def _write(folder: Path, files: dict[str, str]) -> None:
    """Every file, or none. Raises ``UsageError``."""
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(f"{folder} exists and is not empty; choose another folder")
        for path, text in files.items():
            target = folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{folder} cannot be written: {error.strerror or error}") from error
