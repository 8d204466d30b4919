"""``lerobot-eval-sandboxed``: LeRobot's evaluation, with the Hub's code in the sandbox.

It takes the arguments of ``lerobot-eval``, and options of ``make_env`` as ``--sandbox.NAME=VALUE``.
A value is JSON or text: ``--sandbox.policy='{"gpu": true}'``.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import Any

from envhub_sandbox.settings.options import json_or_text, on_lerobots_command_line, use_option_names

_PREFIX = "--sandbox."


def main() -> None:
    """Remove our options from the command line, and call LeRobot's ``main`` with the rest."""
    if find_spec("lerobot") is None:
        sys.exit("lerobot-eval-sandboxed needs LeRobot: pip install 'envhub-sandbox[lerobot]'")
    from envhub_sandbox.integrations.lerobot import install

    options, rest = split_eval_arguments(sys.argv[1:])
    try:
        install(**options)
    except (TypeError, RuntimeError) as error:
        sys.exit(f"lerobot-eval-sandboxed: {error}")
    sys.argv[1:] = rest
    from lerobot.scripts.lerobot_eval import main as evaluate

    with use_option_names(on_lerobots_command_line(_PREFIX)):
        evaluate()


def split_eval_arguments(arguments: list[str]) -> tuple[dict[str, Any], list[str]]:
    """Split arguments into our options, by name, and the others."""
    options, others = {}, []
    for argument in arguments:
        if not argument.startswith(_PREFIX):
            others.append(argument)
            continue
        name, equals, text = argument.removeprefix(_PREFIX).partition("=")
        if not equals:
            sys.exit(f"lerobot-eval-sandboxed: {argument} takes a value: {argument}=...")
        options[name.replace("-", "_")] = json_or_text(text)
    return options, others
