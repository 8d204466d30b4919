"""``python -m tests.libraries [LIBRARY...]``: guides for libraries that CI has no room for.
Each in an environment of its own, with the newest releases that go together. The example that the
guide shows is run as it is. A library without one has a program in this folder, which plays the
same environment without a sandbox and with it, and fails unless the results are equal. A torch
without CUDA is taken from ``$PIP_FIND_LINKS``."""

import argparse
import os
import subprocess
import sys
import tempfile
from importlib.metadata import requires
from pathlib import Path

from uv import find_uv_bin

import envhub_sandbox
import envhub_worker

_EXAMPLES = Path(__file__).parents[2] / "examples"
# What is installed, whose versions are told, and what the example prints when it has done its work.
WANTED = {
    "rllib": (("torch", "ray[rllib]"), ("ray", "gymnasium"), "vector_entry_point: trained on "),
    "rllib_cluster": (
        ("torch", "ray[rllib]"),
        ("ray", "gymnasium"),
        "reached a mean return of 150",
    ),
    "torchrl": (("torch", "torchrl"), ("torchrl", "torch", "gymnasium"), "a rollout of 40 steps"),
    "tianshou": (("torch", "tianshou"), ("tianshou", "gymnasium"), "SubprocVectorEnv: 200 steps"),
    "hydra": (("hydra-core",), ("hydra-core", "omegaconf", "gymnasium"), "100 steps are equal"),
    "pufferlib": (("psutil", "gymnasium"), ("pufferlib", "gymnasium"), "200 steps are equal"),
    "environments": (
        ("highway-env", "gymnasium-robotics", "shimmy>=2", "dm-control", "mujoco<4"),
        ("highway-env", "gymnasium-robotics", "shimmy", "dm-control", "mujoco"),
        "dm_control by shimmy: 200 steps are equal",
    ),
    "wrappers": (
        ("torch", "supersuit", "skrl", "d3rlpy>=2.8"),
        ("supersuit", "skrl", "d3rlpy", "gymnasium"),
        "d3rlpy: 200 steps are equal",
    ),
    "sample_factory": (
        ("torch", "sample-factory"),
        ("sample-factory", "gymnasium"),
        "200 steps are equal",
    ),
}
AFTERWARDS = {
    # later releases are built with what they download; it asks for older pins than it needs
    "pufferlib": ("pufferlib==1.0.1", "gym==0.26.2", "gym_notices"),
    "sample_factory": ("gymnasium>=1.1",),  # it asks for less than 1.0
}
"""What is installed last, without what it asks for."""
_VERSIONS = """
import sys
from importlib.metadata import version
print(", ".join(f"{name} {version(name)}" for name in sys.argv[1:]))
"""


def make(packages: tuple[str, ...], folder: Path, afterwards: tuple[str, ...] = ()) -> Path:
    """An interpreter with these packages, and what ours imports; ``afterwards`` as they are."""
    uv = find_uv_bin()
    subprocess.run([uv, "venv", "--quiet", "--python", sys.executable, str(folder)], check=True)
    python = folder / "bin" / "python"
    install = [uv, "pip", "install", "--quiet", "--python", str(python)]
    for found in os.environ.get("PIP_FIND_LINKS", "").split():
        install += ["--find-links", found]
        without = ["--no-index", "--no-deps", "torch"]
        subprocess.run([*install, *without], check=False)  # else from the index, and it is large
    ours = [one for one in requires("envhub-sandbox") or () if "extra ==" not in one]
    if afterwards:
        ours = [one for one in ours if not one.startswith("gymnasium")]
    subprocess.run([*install, *packages, *ours], check=True)
    if afterwards:
        subprocess.run([*install, "--no-deps", *afterwards], check=True)
    return python


def run(python: Path, library: str, folder: Path) -> bool:
    """Whether the example of a library does its work; prints what it was run with."""
    _, told, printed = WANTED[library]
    paths = {Path(str(one.__file__)).parents[1] for one in (envhub_sandbox, envhub_worker)}
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
        "ENVHUB_CACHE": str(folder / "cache"),
        "HOME": str(folder),
        "RAY_TMPDIR": str(folder),
    }
    versions = [str(python), "-c", _VERSIONS, *told]
    print("with", subprocess.run(versions, capture_output=True, text=True).stdout, end="")
    done = subprocess.run(
        [str(python), str(_program(library))],
        env=environment,
        cwd=folder,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    print(done.stdout, flush=True)
    return done.returncode == 0 and printed in done.stdout


def _program(library: str) -> Path:
    example = _EXAMPLES / f"with_{library}.py"
    return example if example.exists() else Path(__file__).with_name(example.name)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.libraries")
    parser.add_argument("libraries", nargs="*", metavar="library", default=list(WANTED))
    parser.add_argument("--below", type=Path, help="a folder for the environments, 2 GB each")
    options = parser.parse_args()
    if unknown := set(options.libraries) - set(WANTED):
        parser.error(f"no library {', '.join(sorted(unknown))}; there are {', '.join(WANTED)}")
    failed = []
    for library in options.libraries:
        with tempfile.TemporaryDirectory(prefix="rl-", dir=options.below) as name:
            folder = Path(name)
            folder.chmod(0o755)  # jails of root run as another user
            python = make(WANTED[library][0], folder / "venv", AFTERWARDS.get(library, ()))
            failed += [] if run(python, library, folder) else [library]
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
