"""Which names of a worker become attributes in the client: the one place that judges them.

Libraries look for methods under agreed names and call them unasked: ``copy`` calls
``__deepcopy__`` with everything that it has copied so far, numpy reads an address out of
``__array_interface__`` and then reads and writes there, a notebook shows the result of
``_repr_html_``. Such a name must be the client's own or absent, whatever a worker lists. A list of
dangerous names would never be complete, so this module lists the forms of harmless names.
"""

from __future__ import annotations

from typing import Any

from gymnasium.vector import VectorEnv

from envhub_worker.protocol.errors import RemoteProtocolError

MAX_NAME = 512
"""Characters of a suite, task, attribute or package name."""
MAX_NAMES = 1024
"""Names in one list: attributes of an environment, packages of an interpreter."""

SERVED_PRIVATE = frozenset({"_ensure", "_max_episode_steps"})
"""Names with an underscore that callers of vector environments read: LeRobot's."""

PROBED = frozenset(
    {
        # The standard library, pandas and tabulate look for attributes of files, mappings, classes,
        # numbers and dates.
        *("fileno", "read", "write", "getvalue", "keys", "items", "mro"),
        *("as_integer_ratio", "is_integer", "conjugate", "real", "imag", "isoformat"),
        # numpy, pandas, matplotlib, torch, jax, tqdm and wandb look for those of arrays, tensors
        # and tables.
        *("dtype", "shape", "ndim", "size", "flat", "item", "tolist", "toarray", "tocoo"),
        *("to", "cpu", "detach", "numpy", "pin_memory", "block_until_ready", "is_tensor_like"),
        *("to_numpy", "values", "index", "input_objs", "aval", "weak_type"),
        # JSON encoders (pandas, simplejson, wandb) look for methods and call them.
        *("toDict", "for_json", "json_encode"),
        # Notebooks look for those of IPython's help and completion; rich probes for others.
        *("getdoc", "trait_names", "awehoi234_wdfjwljet234_234wdfoijsdfmmnxpi492"),
    }
)
"""Names without an underscore that libraries look for in any object, found by having some forty
convert, print, plot, log, copy and compare one that listens
(``tests/support/objects/curious.py``). Such an attribute can be had by name: ``get_attr`` and
``get_wrapper_attr``."""

GYMNASIUMS = frozenset(dir(VectorEnv)) | {
    *getattr(VectorEnv, "__annotations__", ()),
    *("env", "envs", "env_fns", "num_envs", "autoreset_mode", "copy", "new_step_api"),
    *("single_observation_space", "single_action_space", "observation_space", "action_space"),
    *("metadata", "spec", "render_mode", "closed", "np_random", "np_random_seed"),
}
"""Names that mean something to Gymnasium: they are answered here, or not at all."""


def is_servable(name: str) -> bool:
    """Whether a worker may serve an attribute of this name. Trust: input from the worker.

    Servable names are identifiers without a leading underscore that neither Gymnasium nor a
    library looks for in arbitrary objects, and the few names with an underscore that callers read.
    """
    if name in SERVED_PRIVATE:
        return True
    if name.startswith("_") or not name.isidentifier() or len(name) > MAX_NAME:
        return False
    return name not in GYMNASIUMS and name not in PROBED


def absent(owner: object, name: str, ask: str) -> AttributeError:
    """Returns the error of ``owner`` for a ``name`` that only its method ``ask`` serves."""
    kind = type(owner).__name__
    if name not in PROBED:
        return AttributeError(f"{kind!r} object has no attribute {name!r}")
    return AttributeError(
        f"a {kind} does not serve the attribute {name!r}, which libraries look for in every "
        f"object; if you need it, call {ask}({name!r})"
    )


def checked_name(value: object, role: str) -> str:
    """Returns the value if it is a printable text of bounded length, else raises
    ``RemoteProtocolError``.
    """
    if type(value) is not str or len(value) > MAX_NAME:
        raise RemoteProtocolError(f"{role} is not a string of at most {MAX_NAME} characters")
    if not value.isprintable():  # names are printed all the time, and a terminal obeys what it gets
        raise RemoteProtocolError(f"{role} holds control characters")
    return value


def checked_key(value: object, role: str) -> str:
    """Returns a name that is safe in a path: callers write videos and results under such names.

    A slash is allowed (``ALE/Pong-v5``): it only leads into subfolders.
    Raises ``RemoteProtocolError``: the value is no name, or would lead out of the caller's folder.
    """
    name = checked_name(value, role)
    parts = name.replace("\\", "/").split("/")
    if ".." in parts or (not parts[0] and len(parts) > 1):
        raise RemoteProtocolError(f"{role} {name[:80]!r} would lead out of a folder as a path")
    return name


def optional_name(value: object, role: str) -> str | None:
    """Returns None for None, else ``checked_name``."""
    return None if value is None else checked_name(value, role)


PLAIN_KEYS = (int, float, bool, type(None))
"""Types of keys of metadata, beside text."""


def plain_keys(value: object, role: str) -> dict[Any, Any]:
    """Like ``string_keys``, but a key may also be of ``PLAIN_KEYS``, or a tuple of such keys."""
    if type(value) is not dict or len(value) > MAX_NAMES:
        raise RemoteProtocolError(f"{role} is not a mapping of at most {MAX_NAMES} entries")
    for key in value:
        for part in key if type(key) is tuple else (key,):
            if type(part) not in PLAIN_KEYS:
                checked_name(part, role)
    return value


def string_keys(value: object, role: str) -> dict[str, Any]:
    """Returns a mapping whose keys pass ``checked_name``. Raises ``RemoteProtocolError``."""
    mapping = plain_keys(value, role)
    for key in mapping:
        checked_name(key, role)
    return mapping


def texts_by_name(value: object, role: str) -> dict[str, str]:
    """Returns a mapping whose keys and values pass ``checked_name``."""
    return {key: checked_name(text, role) for key, text in string_keys(value, role).items()}


def servable_names(value: object) -> tuple[str, ...]:
    """Returns the servable attributes and drops the others, which honest classes have, too."""
    if type(value) is not tuple or len(value) > MAX_NAMES:
        raise RemoteProtocolError(f"attributes is not a tuple of at most {MAX_NAMES} names")
    return tuple(filter(is_servable, [checked_name(item, "attributes") for item in value]))


CONVERTED = "envhub_converted"
"""Of a sub-environment whose ``reset`` Gymnasium cannot call: what the sandbox has converted."""
