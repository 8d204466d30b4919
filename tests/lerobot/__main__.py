"""``python -m tests.lerobot [VERSION...]``: all that is tested with LeRobot, each in its own.

An interpreter of its own for each version, with what that version asks for, and the plugin
distribution installed from its folder. A torch without CUDA is taken from ``$PIP_FIND_LINKS``.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from uv import find_uv_bin

from benchmarks import lerobot_venv
from tests.lerobot.kit import OWN

_BOTH = (
    *("torch", "gymnasium>=1.1", "einops", "requests", "safetensors", "packaging<26", "termcolor"),
    *("tqdm", "opencv-python-headless", "Pillow", "av>=15,<16", "jsonlines", "accelerate"),
    *("msgpack", "pyzmq", "cloudpickle", "platformdirs", "typer", "rich", "uv", "pyserial"),
)
WANTED = {
    "0.6.1": ("draccus<0.12", "huggingface-hub>=1.6,<2", "datasets>=4.8,<5"),
    "0.4.4": (
        *("draccus==0.10.0", "huggingface-hub>=0.34.2,<0.36", "datasets>=4,<4.2", "deepdiff"),
        *("imageio[ffmpeg]", "diffusers", "pynput"),
    ),
}
TESTS = tuple(f"tests/lerobot/{name}.py" for name in ("test_pages", "evaluation", "training"))


def make(version: str, folder: Path) -> Path:
    """An interpreter with that LeRobot."""
    plugin = Path(__file__).parents[2] / "plugins" / "lerobot_env_envhub_sandbox"
    uv = [find_uv_bin()]
    subprocess.run([*uv, "venv", "--quiet", "--python", sys.executable, str(folder)], check=True)
    python = folder / "bin" / "python"
    packages = Path(
        subprocess.run(
            [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
            check=True,
            capture_output=True,
            text=True,
        ).stdout.strip()
    )
    install = [*uv, "pip", "install", "--quiet", "--python", str(python)]
    for found in os.environ.get("PIP_FIND_LINKS", "").split():
        install += ["--find-links", found]
        without = ["--no-index", "--no-deps", "torch"]
        subprocess.run([*install, *without], check=False)  # else from the index, and it is large
    subprocess.run([*install, *_BOTH, *WANTED[version]], check=True)
    subprocess.run([*install, "--no-deps", "torchvision", str(plugin)], check=True)
    # where it lies is said, since uv does not install what asks for a newer Python
    target = ["--target", str(packages), "--python-version", "3.12"]
    subprocess.run([*install, "--no-deps", *target, f"lerobot=={version}"], check=True)
    lerobot_venv.adapt(packages)
    return python


def main() -> None:
    """Run the tests with each version; exits with 1 when one of them failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.lerobot")
    parser.add_argument("versions", nargs="*", metavar="version", default=list(WANTED))
    failed = []
    for version in parser.parse_args().versions:
        with tempfile.TemporaryDirectory(prefix="lerobot-") as folder:
            os.chmod(folder, 0o755)  # jails of root run as another user
            python = make(version, Path(folder) / "venv")
            print(f"== LeRobot {version}", flush=True)
            command = [sys.executable, "-m", "pytest", "-q", "--full", *TESTS]
            done = subprocess.run(command, env={**os.environ, OWN: str(python)}, check=False)
            failed += [version] if done.returncode else []
    sys.exit(f"failed with LeRobot {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
