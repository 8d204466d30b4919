"""Variables that are read once, at the start of a process or a library, work or are refused."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import PolicyError
from tests.support.repositories import STILL, write_repository

_ITEMS = "{'red', 'green', 'blue', 'key', 'door', 'box', 'wall'}"
_PRINT = f"print(*{_ITEMS})"
_ENV = f"""{STILL}
import subprocess
import sys
import time

class Tells(Still):
    def order(self):
        return " ".join({_ITEMS})

    def order_of_a_child(self):
        return subprocess.check_output([sys.executable, "-c", {_PRINT!r}], text=True).strip()

    def tell(self, expression):
        return eval(expression)

def make_env(n_envs=1, use_async_envs=False):
    kind = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return kind([Tells] * n_envs)
"""
_BLAS = """[
    getattr(library, name)()
    for path in {line.split()[-1] for line in open('/proc/self/maps') if 'openblas' in line}
    for library in [__import__('ctypes').CDLL(path)]
    for name in ['scipy_openblas_get_num_threads64_', 'openblas_get_num_threads']
    if hasattr(library, name)
][:1] or [1]"""
_WORKS = {
    "PYTHONOPTIMIZE": ("1", "__debug__", False),
    "PYTHONUTF8": ("1", "sys.flags.utf8_mode", 1),
    "PYTHONDEVMODE": ("1", "sys.flags.dev_mode", True),
    "PYTHONWARNINGS": (
        "error::DeprecationWarning",
        "sys.warnoptions",
        ["error::DeprecationWarning"],
    ),
    "PYTHONIOENCODING": ("latin-1:replace", "sys.stdout.encoding", "iso8859-1"),
    "PYTHONTRACEMALLOC": ("3", "__import__('tracemalloc').get_traceback_limit()", 3),
    "TZ": ("Asia/Tokyo", "time.localtime(0).tm_hour", 9),
    "OMP_NUM_THREADS": ("1", _BLAS, [1]),
    "LD_SDK_KEY": ("/own", "__import__('os').environ['LD_SDK_KEY']", "/own"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_repository(tmp_path_factory.mktemp("tells"), _ENV)


def _orders(folder: Path, **options: Any) -> set[str]:
    with make_env(folder, n_envs=2, timeouts={"server_idle_s": 0}, **options) as suites:
        return {*suites.env.call("order"), *suites.env.call("order_of_a_child")}


@pytest.mark.parametrize("seed", [None, "7", "random"])
def test_sets_of_text_have_one_order(
    folder: Path, monkeypatch: pytest.MonkeyPatch, seed: str | None
) -> None:
    """In each use, process and place, and in what is started there: the caller's, or that of 0."""
    monkeypatch.delenv("PYTHONHASHSEED", raising=False)
    if seed is not None:
        monkeypatch.setenv("PYTHONHASHSEED", seed)
    fixed = {"PYTHONHASHSEED": "7" if seed == "7" else "0"}
    expected = subprocess.check_output([sys.executable, "-c", _PRINT], env=fixed, text=True)
    uses: dict[str | None, list[dict[str, Any]]] = {
        None: [{}, {"use_async_envs": True, "num_workers": 2}, {"sandbox": ["process"] * 2}],
        "7": [{}, {"policy": {"environment": ("PYTHONHASHSEED",)}}],
        "random": [{"use_async_envs": True, "num_workers": 2}],
    }
    for options in uses[seed]:
        assert _orders(folder, **options) == {expected.strip()}, options


@pytest.mark.parametrize("name", _WORKS)
def test_what_is_granted_works(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """With one server, in which others run without it."""
    value, expression, expected = _WORKS[name]
    monkeypatch.setenv(name, value)
    with (
        make_env(folder, policy={"environment": (name,)}) as granted,
        make_env(folder, policy={"environment": ()}) as others,
    ):
        assert granted.env.call("tell", expression) == (expected,)
        assert others.env.call("tell", f"'{name}' in __import__('os').environ") == (False,)


@pytest.mark.parametrize("name", ["LD_PRELOAD", "LD_LIBRARY_PATH", "GLIBC_TUNABLES", "PYTHONPATH"])
def test_what_would_do_nothing_is_refused(folder: Path, name: str) -> None:
    with pytest.raises(PolicyError, match=f"environment has {name}, which is read when a process"):
        make_env(folder, policy={"environment": (name,)})
