"""The entry file that stands for an environment which a package registers with Gymnasium.

It is generated here and runs in a jail, as any repository's: what is in the package is looked at
there. ``env.txt`` is its text but for what the reference says.
"""

from __future__ import annotations

from pathlib import Path

from envhub_sandbox.hub.grammar import Parts
from envhub_sandbox.hub.registered.reference import requirement

_TEMPLATE = Path(__file__).with_name("env.txt")


def entry(parts: Parts) -> bytes:
    """The bytes of the file; the same for the same reference."""
    package, _, env_id = parts.repo_id.partition("#")
    text = _TEMPLATE.read_text("utf-8")
    filled = {
        "REQUIREMENT": ascii(requirement(parts)).replace("'", '"'),
        "DISTRIBUTION = None": f"DISTRIBUTION = {package.partition('[')[0]!r}",
        "ENV_ID = None": f"ENV_ID = {env_id!r}",
    }
    for place, value in filled.items():
        assert text.count(place) == 1
        text = text.replace(place, value)
    return text.encode()
