"""``python -m tests.distributions``: both distributions as an index would have them.
Each is built as a source distribution and, out of that, as a wheel; checked by twine; and installed
into an empty environment, where the README's first command has to play from what is installed
alone. Needs the way to an index."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from uv import find_uv_bin

CHECKOUT = Path(__file__).resolve().parents[1]
PLUGIN = "lerobot_env_envhub_sandbox"
PACKED = (
    *("envhub_sandbox", "worker", "examples", "plugins"),
    *("pyproject.toml", "README.md", "LICENSE"),
)
FINDS = f"""
from importlib import metadata, util
assert "{PLUGIN}" in [one.metadata["Name"] for one in metadata.distributions()]
assert util.find_spec("{PLUGIN}"), "there is no module of that name"
"""


def run(*command: str, cwd: Path) -> str:
    print("$", *command, flush=True)
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        command, cwd=cwd, env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    print(done.stdout, end="", flush=True)
    return done.stdout


def build(folder: Path) -> list[Path]:
    """Two source distributions and two wheels, from a copy: builds leave files behind."""
    source = folder / "source"
    left_out = shutil.ignore_patterns("__pycache__", "*.egg-info", "build")
    source.mkdir()
    for name in PACKED:
        if (CHECKOUT / name).is_dir():
            shutil.copytree(CHECKOUT / name, source / name, ignore=left_out)
        else:
            shutil.copy(CHECKOUT / name, source / name)
    for root in (source, source / "plugins" / PLUGIN):
        run(find_uv_bin(), "build", "--quiet", "--out-dir", str(folder / "dist"), cwd=root)
    return sorted(path for path in (folder / "dist").iterdir() if path.suffix in (".whl", ".gz"))


def environment(folder: Path, *packages: str) -> Path:
    """The ``bin`` of an empty environment with these."""
    run(find_uv_bin(), "venv", "--quiet", "--python", sys.executable, str(folder), cwd=CHECKOUT)
    python = str(folder / "bin" / "python")
    install = (find_uv_bin(), "pip", "install", "--quiet", "--python", python)
    run(*install, *packages, cwd=folder)
    return folder / "bin"


def plays(folder: Path, package: Path, plugin: Path) -> None:
    """The end of the README's first command, with these installed instead of the checkout."""
    readme = (CHECKOUT / "README.md").read_text()
    [command] = re.findall(r"^python3 -m venv .*&& \.venv/bin/(envhub run .*)$", readme, re.M)
    bin_folder = environment(folder / "venv", f"{package}[video]", str(plugin))
    shutil.copytree(CHECKOUT / "examples" / "cartpole", folder / "examples" / "cartpole")
    name, *arguments = command.split()
    run(str(bin_folder / name), *arguments, cwd=folder)
    assert (folder / "cartpole.mp4").stat().st_size, "there is no video"
    run(str(bin_folder / name), "run", "examples:cartpole", "--episodes", "2", cwd=folder)
    run(str(bin_folder / "python"), "-c", FINDS, cwd=folder)


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="distributions-") as name:
        folder = Path(name)
        folder.chmod(0o755)  # jails of root run as another user
        built = build(folder)
        twine = environment(folder / "twine", "twine") / "twine"
        run(str(twine), "check", "--strict", *map(str, built), cwd=folder)
        for suffix in (".whl", ".gz"):
            plugin, package = sorted(
                (path for path in built if path.suffix == suffix),
                key=lambda path: not path.name.startswith(PLUGIN),
            )
            (folder / suffix.strip(".")).mkdir()
            plays(folder / suffix.strip("."), package, plugin)
    print("both can be published")


if __name__ == "__main__":
    main()
