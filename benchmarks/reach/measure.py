"""What becomes of one case: its runs in the sandbox, and its control, each a process."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, perf_counter
from typing import Any

import uv

from benchmarks.reach.cases import HERE, Case, removed
from envhub_sandbox.dependencies import index, interpreters

_ROOT = HERE.parents[1]
_NOWHERE = dict.fromkeys(("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"), "http://127.0.0.1:9")
EQUAL = "equal"
UNSEEDED = "differs from itself: no seed reaches its generators"
_MOST = 240
"""Characters of a reason."""


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
        digest: The case's.
        kind: The case's.
        about: The case's.
        alone: Empty if the reference alone did; else why not.
        argument: The one argument that was tried then, as text; empty for none.
        helped: Empty if that did; else why not.
        seconds: Of the runs that succeeded: cold, warm, and without a network.
        mib: Of its environment; 0 for none.
        packages: Their number.
        control: ``"equal"``, where it differs, or why the control failed.
    """

    digest: str
    kind: str
    about: str
    alone: str
    argument: str
    helped: str
    seconds: tuple[float, ...]
    mib: int
    packages: int
    control: str

    @property
    def runs(self) -> bool:
        """Whether it came up, by one way or the other."""
        return bool(self.seconds)


class Failed(Exception):
    """A process did not do what it was for; the text says why."""


class Trial:
    """One case in a folder of its own, with caches of its own, so that the first run is cold.

    Args:
        case: The case.
        client: The interpreter that has envhub-sandbox, and little else.
        folder: An empty folder.
        deadline: When all of it has to be over, by the monotonic clock.
    """

    def __init__(self, case: Case, client: str, folder: Path, deadline: float) -> None:
        self._case = case
        self._client = client
        self._folder = folder
        self._deadline = deadline
        self._own = {
            "ENVHUB_CACHE": str(folder / "cache"),
            "UV_CACHE_DIR": str(folder / "uv"),
            "CI": "1",
        }
        case.write(folder / "repo")

    def outcome(self) -> Outcome:
        """Run it."""
        case, alone, helped = self._case, "", ""
        argument: Mapping[str, Any] = {}
        seconds = self._seconds(argument)
        if isinstance(seconds, str):
            alone, argument = seconds, case.argument
            seconds = self._seconds(argument) if argument else ""
            helped = seconds if isinstance(seconds, str) else ""
        made = self._environment()
        return Outcome(
            digest=case.digest,
            kind=case.kind,
            about=case.about,
            alone=alone,
            argument=json.dumps(argument) if argument else "",
            helped=helped,
            seconds=() if isinstance(seconds, str) else seconds,
            mib=round(made.get("bytes", 0) / 2**20),
            packages=len(made.get("packages", ())),
            control=self._control(),
        )

    def _seconds(self, argument: Mapping[str, Any]) -> tuple[float, ...] | str:
        """Of three runs, or why one of them failed."""
        found: list[float] = []
        for more in ({}, {}, {**_NOWHERE, "UV_OFFLINE": "1"}):
            if more:
                shutil.rmtree(self._folder / "cache/manifests", ignore_errors=True)
            start = perf_counter()
            try:
                self._play(argument, more)
            except Failed as error:
                where = ("", "again: ", "without a network: ")[len(found)]
                return f"{where}{error}"
            found.append(round(perf_counter() - start, 1))
        return tuple(found)

    def _play(self, argument: Mapping[str, Any], more: Mapping[str, str]) -> None:
        order, entry = self._folder / "order.json", self._case.entry
        reference = str(self._folder / "repo") + ("" if entry == "env.py" else f":{entry}")
        asked = {"repository": reference, "arguments": argument, "into": str(self._folder)}
        order.write_text(json.dumps(asked))
        command = [self._client, "-m", "benchmarks.reach.play", str(order)]
        self.run(command, {**os.environ, **self._own, **more}, _ROOT)

    def _environment(self) -> dict[str, Any]:
        command = [self._client, "-I", "-m", "envhub_sandbox", "cache", "list", "--json"]
        try:
            listed = self.run(command, {**os.environ, **self._own}, _ROOT)
        except Failed:  # at the deadline
            return {}
        made = json.loads(listed)["environments"]
        return made[0] if made else {}

    def _control(self) -> str:
        """How the results compare with those of an ordinary process."""
        ours = self._folder / "results.txt"
        try:
            python = self._installed(*self._ordinary(ours.exists()))
            theirs = self._step_by_hand(python)
            if not ours.exists():
                return "runs"
            verdict = _compared(ours.read_text().splitlines(), theirs)
            return verdict if verdict == EQUAL or self._step_by_hand(python) == theirs else UNSEEDED
        except Failed as error:
            return f"fails without a sandbox, too: {error}"
        except Exception as error:
            return f"no control: {error}"[:_MOST]

    def _ordinary(self, ran: bool) -> tuple[str, list[str]]:
        """An interpreter, and what is installed: what our run had, or what its author would."""
        if not ran:
            lines = self._case.control or self._case.files["requirements.txt"].decode().split("\n")
            python = interpreters.find(self._case.python).path
            return python, [*filter(None, lines), "gymnasium"]
        provenance = json.loads((self._folder / "provenance.json").read_text())
        release = provenance["interpreter"]["version"].split()[1].rpartition(".")[0]
        installed = provenance["installed"]
        if installed is None:
            found = provenance["packages"].items()
            return self._client, [f"{name}=={version}" for name, version in found]
        return interpreters.find(release).path, ["--no-deps", *installed["packages"]]

    def _installed(self, python: str, requirements: Sequence[str]) -> str:
        """The interpreter of an environment with these; the client's own, if that was used."""
        if python == self._client:
            return python
        venv, program = self._folder / "control", uv.find_uv_bin()
        own = str(venv / "bin/python")
        variables = {**index.environment(), **self._own, "UV_PYTHON_DOWNLOADS": "never"}
        for words in (
            [program, "venv", "--quiet", "--python", python, str(venv)],
            [program, "pip", "install", "--quiet", "--python", own, *requirements],
        ):
            self.run(words, variables, self._folder)
        return own

    def _step_by_hand(self, python: str) -> list[str]:
        """What the control gives, in a copy of the repository that it may write to."""
        copied = self._folder / "by-hand"
        self._case.write(copied)
        program, results = str(HERE / "control.py"), str(self._folder / "control.txt")
        actions = str(self._folder / "actions.json")
        command = [python, program, str(copied), self._case.entry, actions, results]
        beside = os.pathsep.join(str(copied / one) for one in self._case.path)
        self.run(command, {**os.environ, "PYTHONPATH": beside}, copied)
        return Path(results).read_text().splitlines()

    def run(self, command: Sequence[str], variables: Mapping[str, str], where: Path) -> str:
        """What it printed; it and all that it started end with the deadline.

        Raises:
            Failed: It did, or was late.
        """
        with _output() as said, _output() as failed:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=failed,
                env=dict(variables),
                cwd=where,
                start_new_session=True,
            )
            try:
                code = process.wait(max(1.0, self._deadline - monotonic()))
            except subprocess.TimeoutExpired:
                raise Failed("not done at the deadline") from None
            finally:
                _end(process)
            said.seek(0)
            failed.seek(0)
            if code:
                raise Failed(_reason(failed.read().replace(f"{self._folder}/", ""), code))
            printed: str = said.read()
            return printed


def _output() -> Any:
    return tempfile.TemporaryFile("w+", errors="replace")


def _end(process: subprocess.Popen[bytes]) -> None:
    """All of its group, if any of it is left."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        return
    finally:
        process.wait()


def _reason(printed: str, code: int) -> str:
    """The line that says it, without where it came from: our own error, if there is one."""
    lines = [line.strip(" |") for line in printed.splitlines() if line.strip(" |")]
    errors = [line for line in lines if ": " in line and _is_error(line.partition(":")[0])]
    ours = [line for line in errors if line.startswith("envhub_sandbox.errors.")]
    causes = [line for line in lines if line.startswith(("cause:", "Because"))]
    text = (ours or errors or causes or lines or [f"exit code {code}"])[-1]
    text = text.removeprefix("envhub_sandbox.errors.").partition(" Only plain requirements")[0]
    if errors and causes:
        text = f"{text} ({causes[0]})"
    return text.partition(".py: ")[2][:_MOST] or text[:_MOST]


def _is_error(word: str) -> bool:
    return word.rpartition(".")[2].endswith(("Error", "Exit", "NotInstalled", "Exception"))


def _compared(ours: list[str], theirs: list[str]) -> str:
    for number, (one, other) in enumerate(zip(ours, theirs, strict=False)):
        if one != other:
            return "differs from the reset on" if number == 0 else f"differs from step {number} on"
    return EQUAL if len(ours) == len(theirs) else "is shorter"


def measured(case: Case, client: str, deadline_s: float) -> Outcome:
    """Run a case in a temporary folder, which is removed."""
    folder = Path(tempfile.mkdtemp(prefix="envhub-reach-"))
    folder.chmod(0o755)  # a jail of root is another user
    try:
        return Trial(case, client, folder, monotonic() + deadline_s).outcome()
    finally:
        removed(folder)
