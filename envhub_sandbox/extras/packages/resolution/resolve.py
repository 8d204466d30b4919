"""Resolves requirements to pins: every package with the hashes of its wheels, per interpreter."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from packaging.utils import canonicalize_name
from packaging.version import Version

from envhub_sandbox.errors import DependencyError, LockError
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.declared import Source, WantedPackage, parse_requirement
from envhub_sandbox.extras.packages.request import PackageRequest, Tell
from envhub_sandbox.extras.packages.resolution import index, pylock, uv
from envhub_sandbox.extras.packages.resolution.pylock import Lock, PylockPackage
from envhub_sandbox.settings.options import option_name

WORKERS = ("cloudpickle>=3", "gymnasium>=0.26", "msgpack>=1.0.5", "numpy>=1.21")
"""The needs of the worker in a jail: the repository's versions must satisfy these.
Gymnasium and numpy may be older in a jail than outside."""
_WORKERS_SINCE = {
    "cloudpickle": "2023-11-01",
    "gymnasium": "2022-11-01",
    "gymnasium-notices": "2022-11-01",
    "msgpack": "2023-11-01",
    "numpy": "2022-10-01",
}
"""The days of the first such versions with wheels for Python 3.11: no earlier date applies."""
_RESOLVE_S = 600.0
MOST_SOURCES = 50
"""Packages that one request may build: a repository names them, and each costs a resolution."""
_TORCH = ("torch", "torchvision", "torchaudio")
_CPU_INDEX = ("--torch-backend", "cpu")
_IS_PYTHON = re.compile(
    r"does not satisfy Python|with a matching Python|no usable wheels|requires? Python"
)
_NOT_FOUND = "not found in the package registry"
REQUIRED = "What is required of these packages:"
_BOUNDED = re.compile(
    r"(?<![\w.-])(?!python\b)([A-Za-z][A-Za-z0-9._-]*)(?:\[[\w,-]+\])?[<>=!~]=?\d", re.I
)
_NO_WHEELS = re.compile(r"Wheels are required for `([A-Za-z0-9._-]+)`")
_NO_SOURCES = re.compile(r"A source distribution is required for `([a-z0-9-]+)`")
_NEEDS_PYTHON = re.compile(r"does not satisfy Python>=(3\.\d+)")
_ANSWER = "the answer of uv"


@dataclass(frozen=True)
class Target:
    """The interpreter that packages are for: a local one, or a described one.

    Attributes:
        python: The path of a local interpreter; empty for a described one.
        version: The version of a described interpreter, ``"3.12"``.
        machine: Its machine, as in ``os.uname``; the system is Linux with glibc.
    """

    python: str = ""
    version: str = ""
    machine: str = ""

    def __str__(self) -> str:
        return self.python or f"Python {self.version} on {self.machine}"

    @property
    def options(self) -> tuple[str, ...]:
        """Returns the options for uv."""
        if self.python:
            return ("--python", self.python)
        platform = f"{self.machine}-manylinux_2_28"
        # uv queries some interpreter anyway. It would first run a .venv in or above its working
        # directory, a temporary folder where others may write: this option makes it run ours.
        ours = ("--python", interpreters.own().path)
        return (*ours, "--python-version", self.version, "--python-platform", platform)


def resolve(
    request: PackageRequest,
    target: Target,
    *,
    options: Sequence[str] = (),
    refresh: bool = False,
    tell: Tell = lambda line: None,
    timeout_s: float = _RESOLVE_S,
) -> Lock:
    """Returns pins for a target; accepts only wheels and builds nothing.

    Adds the worker's needs; ignores guesses. The installation needs the same ``options``.
    ``refresh`` makes uv ask the index again in place of its cache. Raises ``DependencyError``, also
    for a version whose files lack a required hash (``reason`` is then ``"integrity"``).
    """
    words = [*uv.NO_BUILDS, "--generate-hashes", *options, *(["--refresh"] if refresh else [])]
    answer = _compiled(request, target, words, tell, timeout_s=timeout_s)
    for row in answer["packages"]:
        row.pop("marker", None)  # it holds for this target
    try:
        packages = pylock.read(answer, _ANSWER)
    except LockError as error:
        text = f"{error}; the index must list the hashes of its packages"
        raise DependencyError(text, reason="resolution") from error
    return Lock(_permitted(packages, request.wanted), tuple(options))


def _compiled(
    request: PackageRequest,
    target: Target,
    words: Sequence[str],
    tell: Tell,
    settings: Mapping[str, str] = {},
    timeout_s: float = _RESOLVE_S,
) -> dict[str, Any]:
    """Returns the answer of ``uv pip compile``; raises as ``resolve``."""
    ours = WORKERS if request.runs_worker else ()
    where = "the worker of envhub-sandbox"
    every = [*request.wanted, *(parse_requirement(text, where) for text in ours)]
    files = {
        "--constraints": _lines(request.constraints),
        "--overrides": _lines(request.override),
        "--excludes": "".join(f"{name}\n" for name in request.without),
    }
    named = {option: f"{option[2:]}.txt" for option, text in files.items() if text}
    ask = partial(
        uv.run,
        [
            *("pip", "compile", "-", "--format", "pylock.toml"),
            *(*target.options, *index.options(), *words),
            *_exclude_newer(request),
            *(word for pair in named.items() for word in pair),
        ],
        what=f"no versions of the packages could be chosen for {target}",
        given=_lines(every),
        timeout_s=timeout_s,
        files={**{name: files[option] for option, name in named.items()}, **settings},
    )
    try:
        return {"packages": []} | pylock.document(ask(tell=tell), _ANSWER)
    except DependencyError as error:
        if error.reason != "resolution":
            raise
        strategy = index.environment().get("UV_INDEX_STRATEGY", "")
        if _NOT_FOUND in str(error) and strategy.startswith("unsafe"):
            _raise_refusal(ask)  # uv treats an index that refuses us as one without the package
        what = _what_is_required(str(error), [*every, *request.constraints, *request.override])
        raise DependencyError(f"{error}\n{what}", reason="resolution") from error


def _exclude_newer(request: PackageRequest) -> Iterator[str]:
    """Yields uv's options for the date of a request; later dates for the worker's own needs."""
    if not request.exclude_newer:
        return
    yield f"--exclude-newer={request.exclude_newer}"
    for name, day in _WORKERS_SINCE.items():
        if request.runs_worker and request.exclude_newer < day:
            yield f"--exclude-newer-package={name}={day}"


def _raise_refusal(ask: Callable[..., str]) -> None:
    """Raise an index's refusal: only this strategy of uv's reports it."""
    try:
        ask(variables={"UV_INDEX_STRATEGY": "first-index"})
    except DependencyError as error:
        if error.reason != "resolution":
            raise


def sources_of(
    request: PackageRequest, target: Target, names: Sequence[str], links: Sequence[str]
) -> list[Source]:
    """Returns source distributions that uv chooses for packages without wheels. Builds nothing.

    Ignores the needs of each source: they are known once its wheel is built.
    """
    known = sorted(names)
    while True:
        try:
            return _sources(request, target, known, links)
        except DependencyError as error:  # uv names one package at a time
            further = set(without_wheels(error)).difference(known)
            if error.reason != "resolution" or not further or len(known) >= MOST_SOURCES:
                raise
            known = sorted(further.union(known))


def newer_sources(request: PackageRequest, lock: Lock, target: Target) -> list[Source]:
    """Returns the sources that pip would build: of packages that a request names, the newest
    releases, where the lock has older ones since only those have wheels. Builds nothing.
    """
    chosen = dict(pin.split("==") for pin in lock.packages)
    named = {canonicalize_name(need.requirement.name): need for need in request.wanted}
    left = {name: need for name, need in named.items() if name in chosen and need.is_open}
    while left:
        newest = replace(request, wanted=tuple(left.values()), runs_worker=False)
        try:
            sources = _sources(newest, target, sorted(left), ("--no-deps",))
            newer = (pin for pin in sources if Version(pin.version) > Version(chosen[pin.name]))
            return list(newer)
        except DependencyError as error:  # uv names one package at a time
            without = left.keys() & set(_NO_SOURCES.findall(str(error)))
            if error.reason != "resolution" or not without:
                return []
            left = {name: need for name, need in left.items() if name not in without}
    return []


def _sources(
    request: PackageRequest, target: Target, names: Iterable[str], words: Sequence[str]
) -> list[Source]:
    """Returns the sources of these packages, as uv chooses them; raises as ``resolve``."""
    words = ["--config-file", "uv.toml", *words]
    answer = _compiled(request, target, words, lambda line: None, _may_be_built(names))
    return [
        Source(row["name"], row["version"], sdist["url"], sdist["hashes"]["sha256"])
        for row in answer["packages"]
        if (sdist := row.get("sdist")) and not row.get("wheels")
    ]


def uploaded(wanted: WantedPackage, python: str) -> str:
    """Returns the day of the newest release, by a wheel or a source; empty if the index states
    none.
    """
    request = PackageRequest("", (wanted,), runs_worker=False)
    ask = partial(_compiled, request, Target(python=python), tell=lambda line: None)
    built = _may_be_built([canonicalize_name(wanted.requirement.name)])
    releases, failed = list[dict[str, Any]](), list[DependencyError]()
    for way, settings in ((uv.NO_BUILDS, {}), (("--config-file", "uv.toml"), built)):
        try:
            releases += ask([*way, "--no-deps"], settings=settings)["packages"]
        except DependencyError as error:
            failed.append(error)
    if not releases:
        raise failed[0]
    newest = max(releases, key=lambda row: Version(row["version"]))
    files = [newest.get("sdist", {}), *newest.get("wheels", ())]
    return max((str(file.get("upload-time", ""))[:10] for file in files), default="")


def _may_be_built(names: Iterable[str]) -> dict[str, str]:
    """Returns uv's settings that permit it to choose these packages as sources."""
    tables = "".join(
        f'[[dependency-metadata]]\nname = "{name}"\nrequires-dist = []\n' for name in names
    )
    quoted = ", ".join(f'"{name}"' for name in names)
    return {"uv.toml": f"no-build = true\nno-binary-package = [{quoted}]\n{tables}"}


def _lines(wanted: Iterable[WantedPackage]) -> str:
    wanted = list(wanted)
    for need in wanted:
        if need.requirement.url is not None:
            raise DependencyError(
                f"{need.where} takes {need.requirement.name} from {need.requirement.url[:200]!r}, "
                "which is not built here; only packages of the index are installed",
                reason="requirement",
            )
    return "".join(f"{need.requirement}\n" for need in wanted)


def is_about_python(error: DependencyError) -> bool:
    """Tells whether uv's text suggests that another Python may help."""
    return _IS_PYTHON.search(str(error)) is not None


def without_wheels(error: DependencyError) -> list[str]:
    """Returns packages without a wheel in uv's text; none if the text asks for another Python."""
    return [] if _NEEDS_PYTHON.search(str(error)) else _NO_WHEELS.findall(str(error))


def _permitted(
    packages: Iterable[PylockPackage], wanted: Sequence[WantedPackage]
) -> tuple[PylockPackage, ...]:
    """Returns the packages, each with only the wheels whose hashes its requirement permits."""
    permitted: dict[str, tuple[set[str], str]] = {}
    for need in wanted:
        if need.hashes:
            key = canonicalize_name(need.requirement.name)
            permitted.setdefault(key, (set(), need.where))[0].update(need.hashes)
    kept = []
    for package in packages:
        wheels, origin = package.wheels, ""
        if package.name in permitted:
            among, origin = permitted[package.name]
            wheels = tuple(wheel for wheel in wheels if f"sha256:{wheel.sha256}" in among)
        if not wheels:
            raise DependencyError(
                f"the index has {package.name}=={package.version}, but no file of it with a hash "
                f"that {origin} names. It was replaced there, or the hash is another file's",
                reason="integrity",
            )
        kept.append(replace(package, wheels=wheels))
    return tuple(kept)


def _what_is_required(said: str, every: Sequence[WantedPackage]) -> str:
    """Lists the requirements that uv's explanation names, with the position of each."""
    words = {canonicalize_name(word) for word in re.findall(r"[A-Za-z0-9][A-Za-z0-9._-]*", said)}
    named = [need for need in every if canonicalize_name(need.requirement.name) in words]
    lines = [
        f"  {need.requirement}  ({need.where}{_from_a_folder(need.requirement.name)})"
        for need in (named or every)[:20]
    ]
    return "\n".join([REQUIRED, *lines])


def _from_a_folder(name: str) -> str:
    """Returns a note if this interpreter's package comes from a folder: the index may lack it."""
    folder = interpreters.installed_from(name)
    host = option_name("dependencies", "host")
    return f"; installed here from {folder}, which {host} uses" if folder else ""


def cures(error: DependencyError) -> Iterator[dict[str, list[str]]]:
    """Yields keys of ``dependencies`` that may help, for the packages in uv's text."""
    message = str(error).partition(REQUIRED)[0]
    unknown = re.findall(rf"([A-Za-z0-9][A-Za-z0-9._-]*) was {_NOT_FOUND}", message)
    unbuilt = re.match(r"([A-Za-z0-9][\w.-]*) \S+(?: \(.{0,300}?\))? has no wheel for", message)
    if unbuilt is not None:
        yield {"override": [unbuilt[1]]}  # another version may have one
        unknown.append(unbuilt[1])
    yield from ({"without": [name]} for name in unknown)
    words = Counter(name.lower() for name in _BOUNDED.findall(message))
    ours = {line.partition(">")[0]: line for line in WORKERS}
    for name, _ in words.most_common():
        yield {"override": [ours.get(name, name)]}


def advice(
    asked: str, tried: Sequence[str], error: DependencyError, cure: Mapping[str, list[str]] | None
) -> str:
    """Returns advice if nothing satisfies all requirements. ``asked``: the requested Python;
    ``tried``: the versions that were tried; ``error``: that of the first; ``cure``: keys of
    ``dependencies`` that help.
    """
    others = ""
    needed = _NEEDS_PYTHON.findall(str(error))
    if needed and (asked or len(tried) > 1):
        python = {"python": max(needed, key=Version), "fetch_python": True}
        others = f" have uv fetch another Python, {option_name('dependencies', python)};"
    elif needed:
        others = f" name another Python, {option_name('dependencies', {'python': max(needed)})};"
    also = f"Python {', '.join(tried)} of this machine were tried. " if len(tried) > 1 else ""
    change = option_name("dependencies", cure or {"override": ["NAME<2"], "without": ["NAME"]})
    known = ", for which there are versions" if cure else ""
    return (
        f"{also}Change one of them in the repository, or for this run with {change}{known};{others}"
        f" or use an interpreter that has the packages, with {option_name('python', 'PATH')}"
    )


def without_cuda(
    request: PackageRequest, lock: Lock, resolved: Callable[[PackageRequest, Sequence[str]], Lock]
) -> Lock:
    """Returns the lock without CUDA, if jails have no GPU and the index has such builds of PyTorch.

    Only the index knows its builds, and many mirrors have none without CUDA: then the first choice
    of versions stays. ``resolved`` takes further options for uv.
    """
    if request.gpu or not lock.has_cuda or os.environ.get("UV_TORCH_BACKEND"):
        return lock
    for attempt, options in _ways_without_cuda(request, lock):
        try:
            lock_without = resolved(attempt, options)
        except DependencyError:
            continue
        if not lock_without.has_cuda:
            return lock_without
    return lock


def _ways_without_cuda(
    request: PackageRequest, lock: Lock
) -> Iterator[tuple[PackageRequest, Sequence[str]]]:
    """Yields the same versions from the user's own index, or else also from PyTorch's."""
    rows = (pin.partition("==") for pin in lock.packages)
    held = tuple(
        parse_requirement(f"{name}=={version.partition('+')[0]}+cpu", "the choice of no CUDA")
        for name, _, version in rows
        if name in _TORCH
    )
    yield replace(request, constraints=(*request.constraints, *held)), ()
    if not index.is_chosen():
        yield request, _CPU_INDEX


def torch_options(lock: Lock) -> tuple[str, ...]:
    """Returns the options with which uv finds these versions again, from the pins alone."""
    without = any(
        pin.partition("==")[0] in _TORCH and pin.endswith("+cpu") for pin in lock.packages
    )
    return _CPU_INDEX if without and not index.is_chosen() else ()


def pins(packages: Iterable[PylockPackage]) -> Lock:
    """Returns the lock that installs the packages."""
    lock = Lock(tuple(packages))
    return replace(lock, options=torch_options(lock))
