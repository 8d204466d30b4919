"""Makes the virtual environments of the other libraries, once; PEER... makes some.

Each gets its own, because their pins disagree with each other and with ours. ``$PIP_FIND_LINKS``
is where a torch without CUDA may lie; PyPI's is large.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import venv
from pathlib import Path

from benchmarks import lerobot_venv
from benchmarks.interpreters import PEER_VENVS

# pip's arguments, one call each. PufferLib 1.0.1 asks for old pins that its vectorization does
# not need, so it comes without its dependencies and gets those that it imports.
REQUIREMENTS: dict[str, list[list[str]]] = {
    "sb3": [["stable-baselines3", "gymnasium[mujoco]"]],
    "pufferlib": [
        ["--no-deps", "pufferlib==1.0.1", "gym==0.26.2", "gym_notices"],
        ["gymnasium[mujoco]", "psutil", "cloudpickle", "filelock", "pettingzoo"],
    ],
    "openenv": [["openenv-core", "gymnasium"]],
    "envpool": [["envpool", "gymnasium[mujoco]"]],
    # its pins of torch and torchvision are looser than they need be, and it wants Python 3.12
    "lerobot": [
        ["torch", "gymnasium", "einops", "draccus<0.12", "huggingface-hub>=1.6,<2", "requests"],
        ["safetensors", "packaging<26", "termcolor", "tqdm", "opencv-python-headless", "Pillow"],
        ["datasets>=4.8,<5", "av>=15,<16", "jsonlines"],
        ["--no-deps", "--ignore-requires-python", "torchvision", "lerobot==0.6.1"],
        ["msgpack", "pyzmq", "cloudpickle", "platformdirs"],  # what this project needs beside it
    ],
}


def make(peer: str, folder: Path) -> None:
    """One peer's environment, from this interpreter, in ``folder/<peer>``.

    Raises:
        subprocess.CalledProcessError: pip failed; it has said why.
    """
    place = folder / peer
    venv.create(place, with_pip=True)
    for arguments in REQUIREMENTS[peer]:
        pip = [str(place / "bin" / "python"), "-m", "pip", "install", "--quiet", *arguments]
        subprocess.run(pip, check=True)
    if peer == "lerobot":
        lerobot_venv.adapt(next((place / "lib").glob("python3*")) / "site-packages")


def main() -> None:
    """Make all, or those that are named; one that fails does not stop the others."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks venvs")
    parser.add_argument("peers", nargs="*", metavar="peer", help=", ".join(REQUIREMENTS))
    parser.add_argument("--into", type=Path, default=PEER_VENVS)
    options = parser.parse_args()
    failed = []
    for peer in options.peers or REQUIREMENTS:
        try:
            make(peer, options.into)
        except subprocess.CalledProcessError:
            failed.append(peer)
    if failed:
        sys.exit(f"not installed: {', '.join(failed)}; they will be skipped")


if __name__ == "__main__":
    main()
