"""What to do where a module is missing, in the words of the place where the repository ran."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from envhub_sandbox.dependencies.choice import Choice
from envhub_sandbox.errors import RequirementError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.option_names import option_name
from envhub_worker.protocol.text import printable

if TYPE_CHECKING:
    from envhub_sandbox.dependencies.declared import Declared

_SHOWN = 20
_MODULE = re.compile(r"No module named '([\w.]+)'")


@dataclass(frozen=True)
class MissingModule:
    """Advice for a repository whose import fails.

    Attributes:
        snapshot: Its files.
        place: The sandbox's name.
        choice: Where its packages were to come from.
        python: The interpreter that the caller named.
        own: Whether it ran in an environment that was made for it.
    """

    snapshot: Snapshot
    place: str
    choice: Choice
    python: str | Path | None
    own: bool

    def advice(self, said: str = "") -> str:
        """What the repository declares, where it imports the module, and what helps.

        Args:
            said: The error's text, which names the module.
        """
        from envhub_sandbox.dependencies.declared import declared

        module = found[1] if (found := _MODULE.search(said)) else ""
        try:
            says = declared(self.snapshot.root, self.snapshot.path)
        except RequirementError as error:
            return f"What it declares cannot be taken: {error}"
        return f"{_what(says, self.snapshot)}.{self._where(module)} {self._cure(module, says)}"

    def _where(self, module: str) -> str:
        from envhub_sandbox.dependencies import guesses

        for name, file, line in guesses.read(self.snapshot) if module else ():
            if name.partition(".")[0] == module.partition(".")[0]:
                return f" {printable(file, 200)}, line {line} imports {name}."
        return ""

    def _cure(self, module: str, says: Declared | None) -> str:
        from envhub_sandbox.dependencies import guesses

        name = next(iter(guesses.of_module(module)), "NAME-OF-THE-PACKAGE")
        extra = option_name("dependencies", {"extra": [name]})
        if self.place == "docker":
            return _in_a_container(extra, self.own)
        if self.place == "remote":
            return _on_another_host(extra, self.own)
        if self.python is not None:
            return f"It ran in {self.python}: install the package there, or leave out that argument"
        if self.own:
            return f"It ran in an environment of its own; the package joins it with {extra}"
        here = f"It ran in this interpreter ({sys.executable})"
        if self.choice.where == "host" and says is not None and says.wanted:
            host = option_name("dependencies", "host")
            return f"{here}, as {host} says; leave that out, and it gets an environment of its own"
        return f"{here}; it gets an environment of its own, and the package in it, with {extra}"


def _what(found: Declared | None, snapshot: Snapshot) -> str:
    if found is not None and found.wanted:
        names = [str(wanted.requirement) for wanted in found.wanted]
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        return f"Its {found.source} declares {', '.join(names[:_SHOWN])}{more}"
    from envhub_sandbox.dependencies.declared import not_read

    seen = not_read(snapshot.root, snapshot.path)
    if seen:
        return (
            f"It has {', '.join(seen)}, which may say what it needs and was not read: "
            "requirements.txt, [project] of pyproject.toml and the metadata of a script are"
        )
    return "It declares no packages"


def _in_a_container(extra: str, own: bool) -> str:
    if own:
        return f"It ran in a container, with packages of its own; this one joins them with {extra}"
    image = option_name("sandbox", "docker:IMAGE")
    return (
        f"It ran in a container, with the image's packages: it gets others with {extra}, or "
        f"with an image that has them (envhub image build REF, then {image})"
    )


def _on_another_host(extra: str, own: bool) -> str:
    if own:
        where = "It ran on another host, in an environment of its own"
        return f"{where}; the package joins it with {extra}"
    return (
        "It ran on another host, with the packages of its server: whoever runs that installs "
        "the package into its interpreter, or starts it with --dependencies, and the package "
        f"comes with {extra}"
    )
