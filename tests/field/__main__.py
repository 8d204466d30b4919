"""``python -m tests.field FOLDER [NAME...]``: small programs of the field's packages, in a jail.

``programs.toml`` has them. The packages are installed into two environments below FOLDER, which
are kept; torch without CUDA is taken from ``$PIP_FIND_LINKS``. Each program runs three times: in a
plain process, where it has to succeed; there under strace, if that is installed; and in a jail. A
line each says how that went and which calls the jail was denied; the end says which of the
permitted calls none of them has made. What no jail permits is marked ``refused``, with why.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError
from envhub_worker.lockdown.seccomp.policy import ALLOW, ByArguments, policy_table
from envhub_worker.lockdown.seccomp.syscalls import NUMBERS
from tests.libraries import make
from tests.support.repositories import write_repository

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = None  # the programs are read with Python 3.11 or later

PROGRAMS = Path(__file__).with_name("programs.toml")
_LIMIT_S = 300.0
_CALL = re.compile(r"^\d+ +(?:<\.\.\. )?([a-z_0-9]+)[( ]", re.MULTILINE)
_REPOSITORY = """
import os, subprocess, sys
import gymnasium as gym

class Field(gym.Env):
    observation_space = action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return 0, {}

    def go(self, code):
        folder = os.environ["TMPDIR"] + "/program"
        os.makedirs(folder)
        with open(folder + "/program.py", "w") as file:
            file.write(code)
        done = subprocess.run(
            [sys.executable, "program.py"], cwd=folder, capture_output=True, text=True)
        return done.returncode, done.stdout[-500:], done.stderr[-500:]

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Field])
"""
Program = Mapping[str, Any]


def programs() -> dict[str, Program]:
    return dict(tomllib.loads(PROGRAMS.read_text()))


def installed(folder: Path, every: Mapping[str, Program]) -> dict[str, Path]:
    found = {}
    for venv in sorted({one["venv"] for one in every.values()}):
        place = (folder / venv).resolve()
        if not place.exists():
            its = [one["packages"] for one in every.values() if one["venv"] == venv]
            make(tuple(sorted({name for packages in its for name in packages})), place)
        found[venv] = place / "bin" / "python"
    return found


def outside(python: Path, code: str, traced: Path | None = None) -> bool:
    """Whether a program succeeds in a plain process; its calls go to ``traced``."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "program.py").write_text(code)
        environment = {**os.environ, "HOME": folder, "TMPDIR": folder}
        trace = [] if traced is None else ["strace", "-f", "-qq", "-s", "0", "-o", str(traced)]
        done = subprocess.run(
            [*trace, str(python), "program.py"],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=_LIMIT_S,
        )
    return succeeded(done.returncode, done.stdout)


def succeeded(code: int, printed: str) -> bool:
    return code == 0 and "ok" in printed


def inside(python: Path, program: Program, profile: str, repository: Path) -> tuple[bool, str]:
    """Whether it succeeds in a jail, and what it was denied, or why it failed."""
    network = program.get("network", "none")
    policy = {"profile": profile, "network": network, "record_denials": True}
    options = {"timeouts": {"call_s": _LIMIT_S}, "dependencies": "host", "python": str(python)}
    try:
        with make_env(str(repository), policy=policy, **options) as suites:
            suites.env.reset()
            [(status, printed, error)] = suites.env.call("go", program["code"])
            denied = ", ".join(suites.env.sandbox.denials() or ())
    except EnvHubError as error:
        return False, str(error)
    if succeeded(status, printed):
        return True, denied
    return False, f"{denied}; {error.strip().splitlines()[-1:]}"


def unused(traces: Path) -> list[str]:
    """The calls that a jail may make, and that no trace has."""
    permitted = {
        name
        for name, verdict in policy_table(namespaced=True, network="none").items()
        if verdict == ALLOW or isinstance(verdict, ByArguments)
    }
    made = {call for one in traces.glob("*.strace") for call in _CALL.findall(one.read_text())}
    return sorted(permitted & set(NUMBERS[os.uname().machine]) - made)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="of programs; by default all of them")
    parser.add_argument("--profile", default="strict")
    arguments = parser.parse_args()
    every = programs()
    pythons = installed(arguments.folder.absolute(), every)
    traces = arguments.folder.absolute() / "traces"
    traces.mkdir(exist_ok=True)
    failed = []
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        repository = write_repository(Path(folder) / "field", _REPOSITORY)
        for name in arguments.names or every:
            python, code = pythons[every[name]["venv"]], every[name]["code"]
            if not outside(python, code):
                print(json.dumps({"program": name, "control": "fails"}), flush=True)
                continue
            if shutil.which("strace"):
                outside(python, code, traces / f"{name}.strace")
            works, told = inside(python, every[name], arguments.profile, repository)
            why = every[name].get("refused", "")
            line = {"program": name, "jail": works, "denied": told, "refused": why}
            print(json.dumps(line), flush=True)
            failed += [] if works != bool(why) else [name]
    print("permitted, and made by none:", " ".join(unused(traces)))
    print("not as expected:", " ".join(failed) or "none")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
