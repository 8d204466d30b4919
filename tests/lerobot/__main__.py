"""``python -m tests.lerobot [VERSION...]``: all that is tested with LeRobot, each in its own.
A version is a release, or ``main``: the newest commit of a clone of LeRobot's repository, which
``--source`` or ``$ENVHUB_LEROBOT_SOURCE`` names (a bare one will do). LeRobot's own tests of
environments lie there as well; without it they are not run, nor is ``main``. An interpreter of its
own for each version, with what that version asks for, and the plugin distribution installed from
its folder. A torch without CUDA is taken from ``$PIP_FIND_LINKS``."""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from uv import find_uv_bin

from benchmarks import lerobot_venv
from tests.lerobot.kit import OWN, THEIRS

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
WANTED["main"] = WANTED["0.6.1"]
TESTS = tuple(
    f"tests/lerobot/{name}.py" for name in ("test_pages", "evaluation", "training", "theirs")
)


def checkout(source: str, version: str, folder: Path) -> Path:
    """The files of that version, from a clone."""
    folder.mkdir()
    commit = "HEAD" if version == "main" else f"v{version}"
    archive = ["git", "-C", source, "archive", commit]
    packed = subprocess.run(archive, check=True, capture_output=True).stdout
    subprocess.run(["tar", "-x", "-C", str(folder)], input=packed, check=True)
    return folder


def make(version: str, folder: Path, source: Path | None = None) -> Path:
    """An interpreter with that LeRobot; of ``main``, of its source."""
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
    wanted = str(source) if version == "main" else f"lerobot=={version}"
    subprocess.run([*install, "--no-deps", *target, wanted], check=True)
    if source is not None:
        subprocess.run([*install, "pytest", "pytest-timeout"], check=True)
    lerobot_venv.adapt(packages)
    return python


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.lerobot")
    parser.add_argument("versions", nargs="*", metavar="version", help=", ".join(WANTED))
    source = os.environ.get("ENVHUB_LEROBOT_SOURCE", "")
    parser.add_argument("--source", default=source, help="a clone of LeRobot's repository")
    options = parser.parse_args()
    known = [version for version in WANTED if version != "main" or options.source]
    failed = []
    for version in options.versions or known:
        if version == "main" and not options.source:
            parser.error("main needs --source: a clone of https://github.com/huggingface/lerobot")
        with tempfile.TemporaryDirectory(prefix="lerobot-") as folder:
            os.chmod(folder, 0o755)  # jails of root run as another user
            found = None
            if options.source:
                found = checkout(options.source, version, Path(folder) / "lerobot")
            python = make(version, Path(folder) / "venv", found)
            print(f"== LeRobot {version}", flush=True)
            command = [sys.executable, "-m", "pytest", "-q", "-rP", "--full", *TESTS]
            variables = {OWN: str(python), THEIRS: str(found or "")}
            done = subprocess.run(command, env={**os.environ, **variables}, check=False)
            failed += [version] if done.returncode else []
    sys.exit(f"failed with LeRobot {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
