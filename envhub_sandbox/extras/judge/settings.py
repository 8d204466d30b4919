"""The settings of a judgement, and the caller's files for them: a policy, and options.

Trust: this module reads no file of the judged repository, which has no say in its judgement.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from envhub_sandbox.errors import EnvHubError, PolicyError
from envhub_sandbox.extras.sources import toml
from envhub_sandbox.extras.sources.checkout import top_of
from envhub_sandbox.hub.local import split_local
from envhub_sandbox.hub.snapshot import is_here
from envhub_sandbox.settings.options import in_python, nearest, use_option_names
from envhub_sandbox.settings.policy import policy_from
from envhub_worker.protocol.text import printable, size_text

if TYPE_CHECKING:
    from envhub_sandbox.vector.suites import EnvSuites

_MOST_BYTES = 16 << 10
_LONGEST = 500


@dataclass(frozen=True, kw_only=True)
class JudgeOptions:
    """The repository to judge, and the settings of the judgement.

    Attributes:
        arguments: Arguments of ``make_env`` beside the reference.
        seed, steps: The seed and the steps of each play.
        resets: Resets in each of four rounds that look for leaks; 0 skips them.
        slow_step_s: Longest permitted median step; resets may take five times as long.
        episode_steps: Steps within which an episode must end, if 30 seconds suffice for them.
        tasks: Chooses ``(suite, task)`` pairs of the environments.
        pictures: Whether to gather data that only the page shows: frames, and memory over time.
    """

    reference: str
    arguments: Mapping[str, Any]
    seed: int = 0
    steps: int = 200
    resets: int = 8
    slow_step_s: float = 1.0
    episode_steps: int = 10_000
    tasks: Callable[[EnvSuites], list[tuple[str, Any]]] = field(
        default=lambda suites: [(suite, task) for suite in suites for task in suites[suite]]
    )
    tell: Callable[[str], None] = lambda what: None
    pictures: bool = False


def merged_settings(policy: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Merges a file's policy with the caller's options, which win limit by limit.
    Raises ``PolicyError``: the file's limits are no table.
    """
    limits = policy.get("limits", {})
    if not isinstance(limits, Mapping):
        raise PolicyError("limits are a table: [limits], with a line for each")
    both = {**limits, **given.get("limits", {})}
    return {**policy, **given, **({"limits": both} if both else {})}


def read_settings(path: Path, known: Collection[str]) -> dict[str, Any]:
    """Reads the options in ``[check]`` of a caller's file, by their names in Python.

    The caller must name the file; nothing searches for it. The current folder may be a stranger's
    clone, whose own file would let him set his permissions and the checks that fail him.
    Raises ``PolicyError``: the file is unreadable, or has an option that is not ``known``.
    """
    document = read_file(path)
    if tables := sorted(set(document) - {"check"}):
        raise PolicyError(
            f"{path} has {', '.join(tables)}{nearest(tables[0], ['check'])}; all that is read is "
            "[check], and below it a line for each option"
        )
    table = document.get("check", {})
    if not isinstance(table, Mapping):
        raise PolicyError(
            f"check in {path} is not a table; write [check] and below it a line for each option"
        )
    options = {name.replace("-", "_"): value for name, value in table.items()}
    unknown = sorted(set(options) - set(known))
    if unknown:
        names = [name.replace("_", "-") for name in sorted(known)]
        near = nearest(unknown[0].replace("_", "-"), names)
        raise PolicyError(
            f"[check] in {path} has no option {', '.join(unknown)}{near}; there are "
            f"{', '.join(names)}"
        )
    return options


def is_judged(path: Path, reference: str) -> bool:
    """Tells whether a file lies in the judged folder, by any path of links; or whether its name
    does, though a link there leads out.
    """
    folder = _folder_of(reference)
    if folder is None:
        return False
    is_in_it = Path(os.path.realpath(path)).is_relative_to(folder)
    return is_in_it or _named_in(path, folder) is not None


def _folder_of(reference: str) -> str | None:
    """Returns the judged folder, links resolved; None for a reference that is not local."""
    if not is_here(reference):
        return None
    try:
        return os.path.realpath(split_local(reference).folder)
    except EnvHubError:
        return None  # the judgement fails too, and its error says why


def folder_below_here(reference: str) -> str:
    """Returns the judged folder's path below the current folder, with a slash at its end; empty if
    they are equal or it lies elsewhere.
    """
    folder, here = _folder_of(reference), Path(os.path.realpath(os.curdir))
    if folder is None or here not in Path(folder).parents:
        return ""
    return f"{printable(Path(folder).relative_to(here).as_posix(), _LONGEST)}/"


def _named_in(path: Path, folder: str) -> Path | None:
    """Resolves a path up to the folder, but follows no link inside the folder."""
    absolute = Path(os.path.abspath(path))
    tops = [parent for parent in absolute.parents if os.path.realpath(parent) == folder]
    return Path(folder, absolute.relative_to(tops[-1])) if tops else None


def _named_in_checkout(path: Path, reference: str) -> Path | None:
    """Applies ``_named_in`` to the git checkout around the judged folder, or to the folder."""
    if not is_here(reference):
        return None
    # the checkout may have lost the folder
    folder = Path(_folder_of(reference) or os.path.realpath(os.path.expanduser(reference)))
    return _named_in(path, str(top_of(folder) or folder))


def is_in_its_checkout(path: Path, reference: str) -> bool:
    """Tells whether a path lies in the judged folder or in the git checkout around it."""
    return _named_in_checkout(Path(os.path.realpath(path)), reference) is not None


def refuse_link_of_the_judged(path: Path, reference: str) -> None:
    """Refuse a report's path that leads through a link of the judged repository or its checkout:
    the link could lead to any file of the user's. Raises ``PolicyError``.
    """
    named = _named_in_checkout(path, reference)
    if named is not None and Path(os.path.realpath(path)) != named:
        raise PolicyError(
            f"{path} is, or lies behind, a link in the repository that is checked, {reference}, "
            "which could lead to any file: take a place outside"
        )


@contextlib.contextmanager
def no_report_but_ours(places: Collection[Path | None], reference: str) -> Iterator[None]:
    """Remove the repository's own files from the paths of reports if a judgement ends without them:
    CI would show the author's text as a result.
    """
    try:
        yield
    except BaseException:
        for path in filter(None, places):
            named = _named_in_checkout(path, reference)
            # also removes a link; a file behind a linked folder is not the repository's
            if named is not None and Path(os.path.realpath(path.parent)) == named.parent:
                with contextlib.suppress(OSError):
                    path.unlink(missing_ok=True)
        raise


def refuse_files_of_the_judged(
    places: Mapping[str, Path | None], reference: str, where: str = ""
) -> None:
    """Refuse settings and reports in the judged repository: it must neither decide how it is judged
    nor hold its own results. Raises ``PolicyError``.
    """
    for option, path in places.items():
        if path is not None and is_judged(path, reference):
            raise PolicyError(
                f"{option} {path} is inside the repository that is checked, {reference}{where}, "
                "and a repository must not influence its own check: take a place outside"
            )


def read_policy(path: Path) -> dict[str, Any]:
    """Reads the fields of a ``Policy`` from a caller's file.
    Raises ``PolicyError``: it is unreadable or a field is wrong; the text names the file.
    """
    fields = read_file(path)
    try:
        with use_option_names(in_python):  # errors name fields as the file does
            policy_from(fields, None)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from error
    return fields


def read_file(path: Path) -> dict[str, Any]:
    """Reads a caller's TOML file.
    Raises ``PolicyError``: it is unreadable.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise PolicyError(f"{path} cannot be read: {error.strerror}") from error
    if len(data) > _MOST_BYTES:
        raise PolicyError(f"{path} is larger than {size_text(_MOST_BYTES)}")
    try:
        return toml.loads(data.decode("utf-8"), _MOST_BYTES)
    except ValueError as error:
        raise PolicyError(f"{path} is not valid TOML: {error}") from error
