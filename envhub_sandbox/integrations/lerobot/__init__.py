"""Sandboxed environments for LeRobot, whose own commands and ``make_env`` stay as they are.

    lerobot-eval --env.discover_packages_path=envhub_sandbox.integrations.lerobot \\
        --env.type=envhub_sandbox --env.repo=org/repo@<commit> --policy.path=...

Importing this package registers that type. What is a configuration of the Hub already, or a plain
reference, comes to the sandbox by ``install()``, after which LeRobot's ``make_env`` loads none of
the Hub's code into this process; ``lerobot-eval-sandboxed`` is ``lerobot-eval`` after it. See
``docs/lerobot.md``.
"""

from __future__ import annotations

from envhub_sandbox.integrations.lerobot.config import SandboxedEnvConfig
from envhub_sandbox.integrations.lerobot.install import install

__all__ = ["SandboxedEnvConfig", "install"]
