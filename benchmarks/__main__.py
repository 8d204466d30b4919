"""Lists the benchmarks, or runs one: ``python -m benchmarks [NAME [ARGUMENT...]]``."""

import ast
import runpy
import sys
from pathlib import Path

NAMES = ("steps", "auto", "growth", "suites", "memory", "remote", "reach", "venvs")


def sentence(name: str) -> str:
    """The first line of its docstring; it is not imported."""
    path = Path(__file__).with_name(name)
    source = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
    return (ast.get_docstring(ast.parse(source.read_text())) or "").splitlines()[0]


if __name__ == "__main__":
    if sys.argv[1:2] == [] or sys.argv[1] in ("-h", "--help"):
        print("usage: python -m benchmarks NAME [ARGUMENT...]; NAME --help has its arguments\n")
        print("\n".join(f"{name:8} {sentence(name)}" for name in NAMES))
    elif sys.argv[1] not in NAMES:
        raise SystemExit(f"there is no benchmark {sys.argv[1]!r}, only {', '.join(NAMES)}")
    else:
        del sys.argv[0]
        runpy.run_module(f"benchmarks.{sys.argv[0]}", run_name="__main__", alter_sys=True)
