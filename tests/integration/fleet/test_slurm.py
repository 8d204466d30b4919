"""The job script for SLURM, with something that runs commands on "nodes" of this machine."""

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.support.processes import eventually

_SRUN = """#!/bin/sh
# every node's task, until the signal that ends the job step
shift
for number in 0 1 2; do SLURM_PROCID=$number "$@" & tasks="$tasks $!"; done
trap 'kill $tasks' TERM
wait $tasks
wait $tasks
"""
_THEIRS = "tcp://127.0.0.1:9"
_TRAIN = """
import json, os, sys
import numpy as np
from envhub_sandbox import make_env

with make_env(sys.argv[1], n_envs=6, num_workers=6, sandbox=os.environ["ENVHUB_PLACES"]) as suites:
    suites.env.reset(seed=1)
    observations = suites.env.step(np.zeros(6, int))[0]
    places = [one["place"] for one in suites.env.sandbox.stats()["workers"]]
    print(json.dumps([observations[:, 0].tolist(), places]))
"""


def test_a_job_trains_against_all_nodes(rows: Path, checkout: Path, tmp_path: Path) -> None:
    """Each node's server is in the list; the program uses all, and nothing is left after it."""
    commands = tmp_path / "bin"
    commands.mkdir()
    worker = Path(sys.executable).with_name("envhub-worker")
    texts = {"srun": _SRUN, "envhub-worker": f'#!/bin/sh\nexec {sys.executable} {worker} "$@"\n'}
    for name, text in texts.items():
        (commands / name).write_text(text)
        (commands / name).chmod(0o755)
    (tmp_path / "train.py").write_text(_TRAIN)
    for number in range(3):  # another user of the nodes knows the job's number
        theirs = tmp_path / f"envhub-7-{number}"
        theirs.mkdir()
        (theirs / "endpoint").write_text(f"{_THEIRS} {'ab' * 32} 1\n")
    variables = {
        **os.environ,
        "PATH": f"{commands}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join([str(checkout), str(checkout / "worker")]),
        "TMPDIR": str(tmp_path),
        "ENVHUB_RUN": str(tmp_path),
        "ENVHUB_ADDRESS": "127.0.0.1",
        "SLURM_JOB_ID": "7",
        "SLURM_NNODES": "3",
    }
    script = checkout / "examples" / "deployment" / "fleet.slurm"
    done = subprocess.run(
        ["bash", script, sys.executable, tmp_path / "train.py", rows],
        env=variables,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    observed, places = json.loads(done.stdout.splitlines()[-1])
    assert observed == list(range(6))
    assert len(set(places)) == 3
    assert _THEIRS not in done.stdout + done.stderr
    assert not (tmp_path / "envhub-7").exists(), "the key was for this job alone"

    def alive() -> bool:
        listed = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True)
        return f"{tmp_path}/envhub-7" in listed.stdout

    assert eventually(lambda: not alive())
