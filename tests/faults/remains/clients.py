"""Runs small client programs as processes of their own, to be ended in every way there is."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

from tests.faults.remains.traces import Traces
from tests.support.processes import eventually
from tests.support.samples import sample

_HEAD = f"""
import os, signal, sys, threading, time
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it is ignored, and that is inherited
from envhub_sandbox import make_env, errors
os.environ["TZ"] = os.environ["TMPDIR"]  # marks everybody below us, and not this process
REPOSITORY = {str(sample("faulty"))!r}

def made(moment="never", fault="", **options):
    fails = {{"moment": moment, "fault": fault}}
    suites = make_env(REPOSITORY, n_envs=2, env_kwargs=fails, **options)
    suites.env.reset()
    suites.env.step([0, 0])
    return suites

def say(text):
    print(text, flush=True)
"""


def start(folder: Path, body: str) -> subprocess.Popen[str]:
    inherited = {name: value for name, value in os.environ.items() if name != "TZ"}
    return subprocess.Popen(
        [sys.executable, "-c", _HEAD + textwrap.dedent(body)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**inherited, "TMPDIR": str(folder)},
    )


def line(client: subprocess.Popen[str]) -> str:
    return client.stdout.readline().strip()


def finish(client: subprocess.Popen[str], timeout_s: float = 240.0) -> str:
    """Everything that a client said until its end, which must come."""
    out, errors = client.communicate(timeout=timeout_s)
    return out + errors


def is_clean(folder: Path) -> bool:
    """Whether nothing of a client remains; ours is never in its folder."""
    return eventually(lambda: not left(folder))


def left(folder: Path) -> list[str]:
    found = Traces.of(folder)
    # groups are named after their server, and bear no folder; the fault matrix looks at those
    kinds = ("processes", "files", "sockets", "mounts")
    return [f"{kind}: {one}" for kind in kinds for one in getattr(found, kind)]
