"""Runs a payload under a name that can be found from outside."""

import ctypes
import importlib

_PR_SET_NAME = 15
_KINDS = (
    *("files", "network", "processes", "leaks", "privileges", "nodes", "resources"),
    *("memory_bomb", "change_tree", "use_card"),
)


def run(name, arguments, alias):
    """What the attack returned; the process is called ``alias`` from then on."""
    call_me(alias)
    return attack_of(name)(**arguments)


def attack_of(name):
    kinds = (importlib.import_module(f"payloads.{kind}") for kind in _KINDS)
    return next(getattr(kind, name) for kind in kinds if hasattr(kind, name))


def call_me(alias):
    ctypes.CDLL(None).prctl(_PR_SET_NAME, alias.encode(), 0, 0, 0)
