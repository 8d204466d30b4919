"""Lists the benchmarks, or runs one: ``python -m benchmarks [NAME [ARGUMENT...]]``."""

import ast
import runpy
import sys
from pathlib import Path

NAMES = ("steps", "auto", "growth", "suites", "memory", "remote", "reach", "venvs")


HELP = ("-h", "--help")


def source(name: str) -> str:
    """The source of a benchmark, which is not imported."""
    path = Path(__file__).with_name(name)
    return (path / "__main__.py" if path.is_dir() else path.with_suffix(".py")).read_text()


def description(name: str) -> str:
    """Its docstring."""
    return ast.get_docstring(ast.parse(source(name))) or ""


if __name__ == "__main__":
    if sys.argv[1:2] == [] or sys.argv[1] in HELP:
        print("usage: python -m benchmarks NAME [ARGUMENT...]; NAME --help has its arguments\n")
        print("\n".join(f"{name:8} {description(name).splitlines()[0]}" for name in NAMES))
    elif sys.argv[1] not in NAMES:
        raise SystemExit(f"there is no benchmark {sys.argv[1]!r}, only {', '.join(NAMES)}")
    elif "ArgumentParser" not in source(sys.argv[1]) and set(HELP) & set(sys.argv[2:]):
        print(description(sys.argv[1]))  # its arguments, if it has any, are described there
    else:
        del sys.argv[0]
        runpy.run_module(f"benchmarks.{sys.argv[0]}", run_name="__main__", alter_sys=True)
