"""``python -m tests.compliance.theirs``: somebody else's tests, with Gymnasium's classes replaced.

::

    python -m tests.compliance.theirs ~/Gymnasium/tests/vector               # all variants
    python -m tests.compliance.theirs ~/Gymnasium/tests/vector --variant frames -- -k autoreset
    python -m tests.compliance.theirs ~/Gymnasium/tests/wrappers --variant single

Gymnasium's releases do not ship these tests: PATH lies in a checkout of it. What follows ``--`` is
for pytest, which runs in the checkout's root, once for each variant. The exit code is 0 if all
passed.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.compliance.theirs.through_sandbox import SERVER, VARIANTS
from tests.remote.listening import listening

HERE = Path(__file__).parent
PLUGIN = "through_sandbox"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.compliance.theirs", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("path", nargs="+", type=Path, help="files or folders of tests")
    parser.add_argument("--variant", action="append", choices=VARIANTS, help="all by default")
    arguments = sys.argv[1:]
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    options = parser.parse_args(arguments[:cut])
    paths = [path.resolve(strict=True) for path in options.path]
    return max([run(paths, one, arguments[cut + 1 :]) for one in options.variant or VARIANTS])


def run(paths: list[Path], variant: str, further: list[str]) -> int:
    print(f"--- {variant}", flush=True)
    root = root_of(paths[0])
    with tempfile.TemporaryDirectory(prefix="envhub-theirs-") as folder, server(variant) as told:
        command = [sys.executable, "-m", "pytest", "-p", PLUGIN, "--variant", variant]
        command += [f"--rootdir={root}", "-p", "no:cacheprovider", *further, *map(str, paths)]
        found = {"PYTHONPATH": str(HERE), "ENVHUB_CACHE": folder, **told}
        return subprocess.run(command, cwd=root, env=os.environ | found, check=False).returncode


def root_of(path: Path) -> Path:
    """The folder that the outermost package of a test lies in."""
    folder = path if path.is_dir() else path.parent
    while (folder / "__init__.py").exists():
        folder = folder.parent
    return folder


@contextlib.contextmanager
def server(variant: str) -> Iterator[dict[str, str]]:
    """For the variant that needs one: a server on loopback, and how the plugin is told of it."""
    if variant != "tcp":
        yield {}
        return
    temporary = tempfile.TemporaryDirectory(prefix="envhub-theirs-")
    with temporary as folder, listening(Path(folder)) as found:
        keys = {"server_key": found.public, "client_key": found.client_key}
        yield {SERVER: json.dumps({"endpoint": found.endpoint, **keys})}


if __name__ == "__main__":
    sys.exit(main())
