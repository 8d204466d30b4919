"""Settings of a judgement that stand in files of the caller's: a policy, and options.

Nothing of the repository that is judged is read here: it has no say in how it is judged.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import PolicyError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CALLERS = "envhub.toml"
_MOST_BYTES = 16 << 10


def policy(path: Path) -> dict[str, Any]:
    """What a caller's file permits: the fields of ``Policy``, limits as a table of their own.

    Raises:
        PolicyError: It cannot be read. Whether its fields are such is for ``make_env`` to say.
    """
    return _read(path)


def merged(policy: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """A file's policy, changed by what was given as options, limit by limit.

    Raises:
        PolicyError: The file's limits are no table.
    """
    limits = policy.get("limits", {})
    if not isinstance(limits, Mapping):
        raise PolicyError("limits are a table: [limits], with a line for each")
    both = {**limits, **given.get("limits", {})}
    return {**policy, **given, **({"limits": both} if both else {})}


def of_the_caller(reference: str, options: Collection[str]) -> dict[str, Any]:
    """The options of ``[check]`` in the ``envhub.toml`` of the folder that one is in.

    None where that folder lies in the one that is judged: no repository says how it is judged.

    Args:
        reference: What is judged.
        options: The names that may stand there.

    Raises:
        PolicyError: The file cannot be read, or says what there is not.
    """
    here = Path.cwd()
    file, judged = here / CALLERS, Path(reference).resolve()
    if not file.is_file() or (judged.is_dir() and here.resolve().is_relative_to(judged)):
        return {}
    table = _read(file).get("check", {})
    if not isinstance(table, Mapping):
        raise PolicyError(f"check in {file} is a table: [check], with a line for each option")
    asked = {name.replace("-", "_"): value for name, value in table.items()}
    unknown = sorted(set(asked) - set(options))
    if unknown:
        names = ", ".join(name.replace("_", "-") for name in sorted(options))
        raise PolicyError(f"[check] of {file} knows no {', '.join(unknown)}; there are {names}")
    return asked


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise PolicyError(f"{path} cannot be read: {error.strerror}") from error
    if len(data) > _MOST_BYTES:
        raise PolicyError(f"{path} is larger than {_MOST_BYTES} bytes")
    try:
        document: dict[str, Any] = tomllib.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise PolicyError(f"{path} is no TOML: {error}") from error
    return document
