"""Folders of packages, installed as for a repository of its own, and what makes jails use them."""

import functools
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import uv

from envhub_sandbox.extras.packages.resolution import index
from envhub_worker.protocol.runtime import Runtime
from tests.support import inside

NEEDED = ("cloudpickle", "msgpack")
"""What the worker imports in a jail, beside gymnasium and numpy."""


def base_interpreter() -> str:
    """The interpreter below the virtual environment that runs the tests."""
    return str(Path(getattr(sys, "_base_executable", sys.executable)).resolve())


def install(folder: Path, *requirements: str, built: str | None = None) -> Runtime:
    """``requirements``, and what the worker needs, as wheels for this interpreter."""
    for numpy, newest in {"1.26.4": (3, 12), "1.23.5": (3, 11)}.items():
        if sys.version_info[:2] > newest and f"numpy=={numpy}" in requirements:
            pytest.skip(f"numpy {numpy} has wheels up to Python 3.{newest[1]}")
    python = base_interpreter()
    command = [uv.find_uv_bin(), "pip", "install", "--quiet", "--no-config"]
    command += ["--only-binary", ":all:", *(["--no-binary", built] if built else [])]
    command += ["--compile-bytecode", "--python", python, "--target", str(folder)]
    # from where the user's own settings say, those for pip included
    where = index.environment()
    subprocess.run([*command, *NEEDED, *requirements], check=True, timeout=300, env=where)
    return Runtime(python, str(folder))


@contextmanager
def installed_once(built: str | None = None) -> Iterator[Callable[[tuple[str, ...]], Runtime]]:
    """Gives the runtime with some requirements; each is installed once, and in the end removed."""
    folder = Path(tempfile.mkdtemp(prefix="envhub-environments-"))
    folder.chmod(0o755)

    @functools.cache
    def runtime(requirements: tuple[str, ...]) -> Runtime:
        number = len(list(folder.iterdir()))
        return install(folder / str(number), *requirements, built=built)

    yield runtime
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def running_on(runtime: Runtime) -> Iterator[None]:
    """While it lasts, ``make_env`` gives its jails this interpreter and these packages."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(*inside.CHOICE_OF_PACKAGES, lambda *asked, **options: None)
        patch.setattr(*inside.CHOICE_OF_RUNTIME, lambda python: runtime)
        yield
