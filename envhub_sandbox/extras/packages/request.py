"""Decides which packages a repository needs, by its declarations and the ``dependencies`` argument.

The result is the same for every place that runs the repository. Reading runs nothing.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.settings.options import nearest, option_name
from envhub_worker.protocol.records import dataclass

if TYPE_CHECKING:  # slow to import, and most repositories need no packages
    from envhub_sandbox.extras.packages.declared import WantedPackage
    from envhub_sandbox.extras.packages.modules import Guess

Tell = Callable[[str], None]
"""Receives one line of progress for people."""
DATE = r"\d{4}-\d{2}-\d{2}(T\d{2}:\d{2}:\d{2}(Z|[+-]\d{2}:\d{2}))?"
AS_WRITTEN = "auto"
"""Stands for the repository's own date."""
_DECLARE = ("requirements.txt", "pyproject.toml")
_SCRIPT, _LOOKED_AT = b"# /// script", 1024 * 1024  # as ``declared.py`` has them
_ALIKE = 0.85
"""Names at least this similar count as misspelt; mujoco and mujoco-py are less similar."""
_NAMES = ("extra", "only", "without", "override", "python", "fetch_python", "exclude_newer")


@dataclass(frozen=True)
class Choice:
    """The source of a repository's packages.

    Attributes:
        where: ``"auto"``: its own environment, unless this interpreter meets everything;
            ``"host"``: this interpreter; ``"own"``: its own environment.
        python: A version or versions, or a path; empty for any that the repository supports.
        exclude_newer: A date: later releases are ignored; or ``"auto"`` for the repository's own
            date.
        infer: Whether imported but undeclared packages are installed too.
        only: Requirements in place of the declared ones; None keeps the declared ones.
        without: Names of packages to leave out, even if other packages require them.
        override: Requirements that replace all others for the same package.
        fetch_python: Whether uv may download an interpreter that this machine lacks.
    """

    where: Literal["auto", "host", "own"]
    extra: tuple[WantedPackage, ...] = ()
    python: str = ""
    exclude_newer: str | None = None
    infer: bool = True
    only: tuple[WantedPackage, ...] | None = None
    without: tuple[str, ...] = ()
    override: tuple[WantedPackage, ...] = ()
    fetch_python: bool = False


AUTO, HOST, DECLARED = Choice("auto"), Choice("host"), Choice("auto", infer=False)


def chosen(
    dependencies: str | os.PathLike[str] | Mapping[str, Any], python: str | Path | None
) -> tuple[Choice, str | Path | None]:
    """Returns the choice, and the caller's interpreter if its packages are used.

    Takes the arguments of ``make_env``; ``python`` wins over ``"auto"``.
    Raises ``PolicyError`` and ``DependencyError``.
    """
    if isinstance(dependencies, Mapping):
        if python is not None:
            raise _both()
        return _adjusted(dependencies), None
    if dependencies in ("auto", "declared", "host"):
        own = {"auto": AUTO, "declared": DECLARED}.get(str(dependencies), HOST)
        return (own, None) if python is None else (HOST, python)
    if not isinstance(dependencies, (str, os.PathLike)) or os.sep not in os.fspath(dependencies):
        raise PolicyError(
            f"dependencies is {dependencies!r}; it takes 'auto', 'declared', 'host', the path of "
            "an interpreter or a virtual environment such as './.venv', or a mapping of "
            f"{', '.join(_NAMES)}"
        )
    if python is not None:
        raise _both()
    path = Path(dependencies).expanduser()
    return HOST, path / "bin" / "python" if path.is_dir() else path


def _both() -> PolicyError:
    return PolicyError(
        f"{option_name('python')} and {option_name('dependencies')} both say where packages come "
        f"from; give {option_name('python', 'PATH')} for the packages of an interpreter of yours, "
        f"or {option_name('dependencies', {'python': '3.12'})} for the repository's own"
    )


def _adjusted(given: Mapping[str, Any]) -> Choice:
    unknown = sorted(str(name) for name in given if name not in _NAMES)
    if unknown:
        raise PolicyError(
            f"dependencies has no key {', '.join(unknown)}{nearest(unknown[0], _NAMES)}; it takes "
            f"{', '.join(_NAMES)}"
        )
    fetch = given.get("fetch_python", False)
    if not isinstance(fetch, bool):
        raise PolicyError(f"fetch_python in dependencies is {fetch!r}; it takes True or False")
    only = given.get("only")
    return Choice(
        "own",
        _requirements(given, "extra"),
        _python(given.get("python")),
        _date(given.get("exclude_newer")),
        infer=only is None,
        only=None if only is None else _requirements(given, "only"),
        without=_names(given),
        override=_requirements(given, "override"),
        fetch_python=fetch,
    )


def _requirements(given: Mapping[str, Any], name: str) -> tuple[WantedPackage, ...]:
    texts = given.get(name, ())
    if not isinstance(texts, (list, tuple)) or not all(isinstance(text, str) for text in texts):
        raise PolicyError(f"{name} in dependencies is {texts!r}; it takes a list of requirements")
    from envhub_sandbox.extras.packages.declared import parse_requirement

    return tuple(parse_requirement(text, f"{text[:80]!r} in dependencies") for text in texts)


def _names(given: Mapping[str, Any]) -> tuple[str, ...]:
    from packaging.utils import canonicalize_name

    texts = _requirements(given, "without")
    for package in texts:
        if str(package.requirement) != package.requirement.name:
            raise PolicyError(
                f"without in dependencies has {str(package)!r}; it takes names of packages"
            )
    return tuple(canonicalize_name(package.requirement.name) for package in texts)


def _python(given: object) -> str:
    from envhub_sandbox.extras.packages.declared import check_versions

    text = os.fspath(given) if isinstance(given, os.PathLike) else given or ""
    try:
        if not isinstance(text, str):
            raise ValueError("no text")
        check_versions(text)
    except ValueError as error:
        raise PolicyError(
            f"python in dependencies is {given!r}; it takes a version such as '3.12', versions "
            "such as '>=3.11,<3.13', or the path of an interpreter"
        ) from error
    return text


def _date(given: object) -> str | None:
    if given is None:
        return None
    text = given if isinstance(given, str) else getattr(given, "isoformat", lambda: "")()
    try:
        is_date = re.fullmatch(DATE, text) and date.fromisoformat(text[:10])
    except ValueError:  # no date of the calendar
        is_date = None
    if text != AS_WRITTEN and not is_date:
        raise PolicyError(
            f"exclude_newer in dependencies is {given!r}; it takes a date such as '2026-01-31', or "
            f"{AS_WRITTEN!r} for the day of the repository's commit, release or newest file"
        )
    return str(text)


@dataclass(frozen=True)
class PackageRequest:
    """The packages that a repository needs. Fields that ``Choice`` has too mean the same here.

    Attributes:
        source: The file or the argument that names the packages.
        supports: The versions of Python that the repository supports; empty for any.
        python: The version, versions or path from the caller; empty for none.
        always: Whether it gets its own environment even if the place meets everything.
        guesses: Its imports; a guess is installed unless another package brings the module.
        constraints: Limits for packages, if something requires these.
        gpu: Whether its jails get a GPU.
        runs_worker: Whether the worker runs with these packages, which then include its own needs.
    """

    source: str
    wanted: tuple[WantedPackage, ...]
    supports: str = ""
    python: str = ""
    exclude_newer: str | None = None
    always: bool = False
    guesses: tuple[Guess, ...] = ()
    constraints: tuple[WantedPackage, ...] = ()
    without: tuple[str, ...] = ()
    override: tuple[WantedPackage, ...] = ()
    fetch_python: bool = False
    gpu: bool = False
    runs_worker: bool = True


def request_of(snapshot: Snapshot, choice: Choice, *, gpu: bool = False) -> PackageRequest | None:
    """Returns a repository's request; None if it uses the place's own packages unchanged."""
    if choice.where == "host":
        return None
    auto, found = choice.where == "auto", None
    if choice.only is None and may_declare(snapshot.root, snapshot.path):
        from envhub_sandbox.extras.packages.declared import declared

        found = declared(snapshot.root, snapshot.path)
    guesses = _guesses(snapshot, choice)
    if auto and found is None and not guesses:
        return None
    says = (found.wanted if found else ()) if choice.only is None else choice.only
    if choice.without:
        every = _guesses(snapshot, replace(choice, without=()))
        _refuse_misspelt(choice.without, (*says, *choice.extra), every)
    argument = "what it imports" if auto else "the argument dependencies"
    return PackageRequest(
        source=found.source if found else argument,
        wanted=(*says, *choice.extra),
        supports=found.python if found else "",
        python=choice.python,
        exclude_newer=choice.exclude_newer,
        always=not auto,
        guesses=guesses,
        constraints=found.constraints if found else (),
        without=choice.without,
        override=choice.override,
        fetch_python=choice.fetch_python,
        gpu=gpu,
    )


def _refuse_misspelt(
    without: Sequence[str], wanted: Sequence[WantedPackage], guesses: Sequence[Guess]
) -> None:
    """Refuse a name that is nearly that of a package which the repository declares or imports. Any
    other unknown name passes: such a package may be needed by another package.
    """
    from packaging.utils import canonicalize_name

    known = {str(canonicalize_name(package.requirement.name)) for package in wanted}
    known |= {name for guess in guesses for name in guess.brought_by}
    for name in set(without) - known:
        others = sorted(other for other in known if not name.startswith(other))
        if near := nearest(name, others, _ALIKE):
            raise PolicyError(f"without in dependencies has {name!r}{near}, which nothing declares")


def _guesses(snapshot: Snapshot, choice: Choice) -> tuple[Guess, ...]:
    if not choice.infer:
        return ()
    from envhub_sandbox.extras.packages.modules import guessed

    left_out = set(choice.without)
    return tuple(guess for guess in guessed(snapshot) if left_out.isdisjoint(guess.brought_by))


def may_declare(root: Path, entry: str) -> bool:
    """Tells whether the files may declare packages: a quick look, since reading takes longer."""
    folders = dict.fromkeys(((root / entry).parent, root))
    if any((folder / name).is_file() for folder in folders for name in _DECLARE):
        return True
    with (root / entry).open("rb") as file:
        return _SCRIPT in file.read(_LOOKED_AT)
