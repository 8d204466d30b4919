"""``envhub gc``: remove what clients that were killed left behind."""

from __future__ import annotations

from typing import Annotated

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import out, print_json, safe_line, say
from envhub_sandbox.cli.shared.exits import Exit


@opt.with_options()
def gc(
    dry_run: Annotated[
        bool, typer.Option("--dry-run", "-n", help="Say what would be removed.")
    ] = False,
    json: opt.Json = False,
) -> None:
    """Remove containers, runtime folders and control groups whose client is gone.

    Usually there are none: they end with the client. Never touched are those of a client that
    still runs, of another machine's clients while they run, or of anything but envhub; nor those
    of another user, but root removes every user's containers and control groups. Exit code 9 says
    that an engine is installed and could not be asked.
    """
    from envhub_sandbox.sandboxes.docker import prune

    found, unasked = prune.find()
    removed = [] if dry_run else [one for one in found if one.remove()]
    if json:
        items = [{"kind": one.kind, "name": one.name, "removed": one in removed} for one in found]
        print_json({"found": items, "unasked": unasked})
    for one in () if json else found:
        done = "removed" if one in removed else "found" if dry_run else "could not remove"
        out(f"{done}: {one.kind} {safe_line(one.name, 300)}")
    for engine, why in unasked.items():
        reason = safe_line(why, 500)
        say(f"{engine} could not be asked, so its containers are not known: {reason}")
    if not json:
        say(f"{len(found)} left behind, {len(removed)} removed.")
    if unasked:
        raise typer.Exit(Exit.UNASKED)
