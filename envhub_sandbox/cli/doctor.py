"""``envhub doctor``: tests what this host, or a server on another host, can enforce.

It tries each profile with an environment of Gymnasium in a jail, self-test included, and concludes
nothing from versions or settings. A jail stops at the first missing layer, so each layer is also
tried alone, to name all missing ones at once. On macOS and Windows jails run only in containers, so
there only the requested profile is tried, in a container.
"""

from __future__ import annotations

import contextlib
import json as json_format
import os
import platform
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import (
    BAD,
    GOOD,
    ProgressBar,
    out,
    print_json,
    safe_line,
    safe_text,
    show_below,
    show_rows,
)
from envhub_sandbox.cli.shared.exits import Exit, UsageError, describe
from envhub_sandbox.cli.shared.host import free_memory_bytes, versions
from envhub_sandbox.errors import EnvHubError, SandboxUnavailableError, SnapshotError
from envhub_sandbox.system import extras
from envhub_sandbox.system.platform import IS_LINUX, NAME, user_id
from envhub_worker.protocol.confinement import PROFILES

_PROBE_S = 60.0
_PROFILES = ("profile", "available", "first step", "enforces", "without")
_LAYERS = ("layer", "state", "what it does")
_ENTRY = """
import gymnasium as gym

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1")] * n_envs)
"""
_NOTHING_PROBED: dict[str, Any] = {"layers": [], "apparmor_profile": None, "gpu": None}
_SANDBOX = "process" if IS_LINUX else "docker"


@dataclass(frozen=True)
class Trial:
    """The result of trying one profile.

    Attributes:
        available: Whether a jail with this profile ran.
        layers: A mapping for each layer: ``layer``, ``enforced``, ``detail``.
        first_step_s: Seconds from ``make_env`` to the first step's result.
        problem: Why the profile is not available, and what to do.
        code: The exit code for the problem.
    """

    profile: str
    available: bool = False
    layers: list[dict[str, Any]] = field(default_factory=list)
    first_step_s: float | None = None
    problem: str | None = None
    code: Exit = Exit.OK


@opt.with_options()
def doctor(
    server: Annotated[
        str | None,
        typer.Argument(
            metavar="[tcp://HOST:PORT[ KEY]]",
            help="A server on another host, to test instead of this one. Its public key is in "
            "$ENVHUB_SERVER_KEY or known_hosts, or follows the address: 'tcp://HOST:PORT KEY'.",
        ),
    ] = None,
    profile: Annotated[
        str,
        typer.Option(
            metavar="|".join(PROFILES),
            help="The profile that decides the exit code.",
            autocompletion=lambda: list(PROFILES),
        ),
    ] = "strict",
    json: opt.Json = False,
    insecure_loopback: Annotated[
        bool,
        typer.Option("--insecure-loopback", help="Test a server on this machine that has no keys."),
    ] = False,
) -> None:
    """Test what this host can enforce, and print what is missing and how to get it.

    Exit code 0: this host can enforce the profile (strict by default); 6: it cannot; 5: the jail
    died or timed out; 3: only the cache cannot be used. For a server, 6 also if it does not answer
    or does not accept the key, and 5 if it drains or refuses.
    """
    from envhub_sandbox.settings.policy import Policy

    Policy(profile=profile)  # raises for an unknown profile, before anything is tried
    if server is not None:
        purpose, module = "a server on another host", "envhub_sandbox.extras.remote"
        remote = extras.required(f"{module}.sandbox", "RemoteSandbox", purpose)
        examine_server = extras.required(f"{module}.doctor", "examine_server", purpose)
        sandbox = remote(server, insecure_loopback=insecure_loopback)
        raise typer.Exit(examine_server(sandbox, profile, json=json))
    if insecure_loopback:
        raise UsageError("--insecure-loopback needs a server: envhub doctor tcp://HOST:PORT")
    with ProgressBar(quiet=json) as bar, _scratch_folder() as folder:
        (folder / "idle").mkdir()
        (folder / "idle" / "env.py").write_text(_ENTRY)
        trials = []
        for name in PROFILES if IS_LINUX else (profile,):
            bar.begin(f"trying {name}")
            trials.append(examine(str(folder / "idle"), name))
        bar.begin("trying each layer")
        probed = probe() if IS_LINUX else dict(_NOTHING_PROBED)
    cache = _cache_problem(by_others=profile != "strict" or not trials[0].available)
    if json:
        report = {"host": host(), "versions": versions(), "engine": engine(), **resources(cache)}
        print_json({**report, "profiles": list(map(asdict, trials)), **probed})
    else:
        _print(trials, profile)
        _print_missing(probed)
        if cache is not None:
            out()
            out(f"The cache: {safe_line(cache, 1000)}")
    decisive = next(trial for trial in trials if trial.profile == profile)
    raise typer.Exit(decisive.code or (Exit.SNAPSHOT if cache else Exit.OK))


@contextlib.contextmanager
def _scratch_folder() -> Iterator[Path]:
    """Make a folder for a repository and a cache: a problem of the user's cache hides no layer.
    Raises ``SandboxUnavailableError``: no temporary folder is writable.
    """
    from envhub_sandbox.system.folders import CACHE_VARIABLE

    try:
        scratch = tempfile.TemporaryDirectory(prefix="envhub-doctor-")
    except OSError as error:
        raise SandboxUnavailableError(
            f"no folder for temporary files is writable ({error.strerror}); set TMPDIR to one, or "
            "start a read-only container with --tmpfs /tmp"
        ) from error
    before = os.environ.get(CACHE_VARIABLE)
    with scratch as folder:
        os.chmod(folder, 0o755)  # jails of another user read it
        os.environ[CACHE_VARIABLE] = f"{folder}/cache"
        try:
            yield Path(folder)
        finally:
            os.environ.pop(CACHE_VARIABLE)
            if before is not None:
                os.environ[CACHE_VARIABLE] = before


def _cache_problem(*, by_others: bool) -> str | None:
    """Say why the user's cache cannot be used, and what to do; None if it can.
    ``by_others``: whether root's jails read it as another user, as they do without a private root.
    """
    from envhub_sandbox.system.folders import cache_root

    try:
        root = cache_root()
    except SnapshotError as error:
        return str(error)
    existing = next(path for path in (root, *root.parents) if path.exists())
    cure = f"set ENVHUB_CACHE to another folder, such as {tempfile.gettempdir()}/envhub-cache"
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        return f"{root} cannot be written: {cure}"
    closed = [path for path in (existing, *existing.parents) if not path.stat().st_mode & 0o001]
    if IS_LINUX and user_id() == 0 and by_others and closed:
        return (
            f"{root} cannot be read by the user of root's jails, because {closed[-1]} is closed to "
            f"other users: {cure}"
        )
    return None


def host() -> dict[str, Any]:
    """Return facts about this machine that explain the results."""
    return {
        "system": f"{platform.system()} {platform.release()}",
        "machine": platform.machine(),
        "root": user_id() == 0,
        "python": f"{platform.python_implementation()} {platform.python_version()}",
    }


def engine() -> dict[str, Any]:
    """Describe the container engine of ``sandbox="docker"``, or say why there is none."""
    module = "envhub_sandbox.extras.docker.engines"
    try:
        container_engine = extras.required(module, "find_engine", "a container engine")(None)
    except EnvHubError as error:
        return {"kind": None, "version": None, "rootless": None, "problem": describe(error)}
    facts = {
        "kind": container_engine.kind,
        "version": container_engine.version,
        "rootless": container_engine.rootless,
    }
    return {**facts, "problem": None}


def resources(problem: str | None) -> dict[str, Any]:
    """Return the free bytes of memory, None if the kernel does not say, and of the cache's disk."""
    from envhub_sandbox.system.folders import cache_root

    disk: dict[str, Any] = {"folder": None, "free_bytes": None, "problem": problem}
    with contextlib.suppress(SnapshotError):  # ``problem`` already says it
        folder = next(path for path in (cache_root(), *cache_root().parents) if path.is_dir())
        disk |= {"folder": str(folder), "free_bytes": shutil.disk_usage(folder).free}
    return {"free_memory_bytes": free_memory_bytes(), "disk": disk}


def probe() -> dict[str, Any]:
    """Try each layer alone; return ``layers``, an ``apparmor_profile`` or None, and ``gpu``.

    ``gpu``: the device nodes that ``gpu=True`` grants, or None if they cannot be determined.
    """
    from envhub_sandbox.sandboxes.process import worker_program

    command = worker_program("probe")
    try:
        done = subprocess.run(command, capture_output=True, timeout=_PROBE_S, check=True, cwd="/")
        results = json_format.loads(done.stdout)
    except (OSError, subprocess.SubprocessError, ValueError):
        return dict(_NOTHING_PROBED)  # the trials of profiles remain valid
    kept = {name: results[name] for name in ("layers", "apparmor_profile")}
    return {**kept, "gpu": results["host"]["gpu"]}


def examine(folder: str, profile: str) -> Trial:
    """Run the idle environment with a profile, in this platform's sandbox."""
    from envhub_sandbox.factory.make_env import make_env

    begun = time.perf_counter()
    try:
        with make_env(folder, policy={"profile": profile}, sandbox=_SANDBOX) as suites:
            env = suites.env
            env.reset(seed=0)
            env.step(env.action_space.sample())
            taken = time.perf_counter() - begun
            layers = [dict(layer) for layer in suites.provenance["layers"]]
    except EnvHubError as error:
        missing = isinstance(error, SandboxUnavailableError)
        problem = describe(error).replace(f"{folder}:env.py: ", "")
        return Trial(profile, problem=problem, code=Exit.SANDBOX if missing else Exit.WORKER)
    return Trial(profile, available=True, layers=layers, first_step_s=taken)


def _print(trials: list[Trial], profile: str) -> None:
    """Print the requested profile's layers, and the missing layers of every other profile."""
    facts = host()
    user = "root" if facts["root"] else "a plain user"
    out(f"{facts['system']} on {facts['machine']}, as {user}, {facts['python']}")
    if not IS_LINUX:
        out()
        out(
            f"On {NAME} nothing can confine a process: there is no --sandbox process. What follows "
            "is --sandbox docker; the other way is a Linux host where 'envhub-worker listen' runs, "
            "with --sandbox tcp://HOST:PORT (check it with: envhub doctor tcp://HOST:PORT)."
        )
    trials = sorted(trials, key=lambda trial: trial.profile != profile)
    out()
    bad = {number: "red" for number, trial in enumerate(trials, 1) if not trial.available}
    show_rows([_PROFILES, *map(_profile, trials)], right=(2,), styles=bad)
    for trial in trials:
        if trial.problem is None and trial.profile == profile:
            out()
            out(f"{trial.profile}: available", GOOD)
            show_rows([_LAYERS, *map(_layer, trial.layers)])
    problems: dict[str, list[str]] = {}
    for trial in trials:
        if trial.problem is not None:
            problems.setdefault(trial.problem, []).append(trial.profile)
    for problem, names in problems.items():
        out()
        out(f"{', '.join(names)}: not available here", BAD)
        show_below(problem)


def _profile(trial: Trial) -> list[str]:
    """Return a row of the table: whether a profile is available, and its missing layers."""
    if not trial.available:
        return [trial.profile, "no", "", "", ""]
    lacks = [str(layer.get("layer")) for layer in trial.layers if not layer.get("enforced")]
    holds = f"{len(trial.layers) - len(lacks)} of {len(trial.layers)} layers"
    return [trial.profile, "yes", f"{trial.first_step_s:.2f} s", holds, ", ".join(lacks)]


def _layer(layer: dict[str, Any]) -> list[str]:
    mark = "holds" if layer.get("enforced") else "missing"
    return [str(layer.get("layer")), mark, str(layer.get("detail"))]


def _print_missing(probed: dict[str, Any]) -> None:
    if probed["gpu"] is not None:
        nodes = ", ".join(map(safe_line, probed["gpu"]))
        out()
        out(f"GPU: {nodes or 'none here, and a policy with gpu=True is refused'}")
    missing = [layer for layer in probed["layers"] if not layer["available"]]
    if missing:
        out()
        out("Layers that are missing here, each tried on its own:", "bold")
    for layer in missing:
        show_below(f"{safe_line(layer['layer'])}: {safe_line(layer['detail'])}")
        show_below(layer["fix"], "    ")
    if probed["apparmor_profile"]:
        out()
        out("An AppArmor profile that permits user namespaces to this interpreter:")
        out(safe_text(probed["apparmor_profile"]))
