"""Sandboxed environments for LeRobot, whose own commands and ``make_env`` stay as they are.

    lerobot-eval --env.discover_packages_path=envhub_sandbox.integrations.lerobot \\
        --env.type=envhub_sandbox --env.repo=org/repo@<commit> --policy.path=...

Importing this package registers that type. ``install()`` brings LeRobot's own configurations of the
Hub, and plain references, into the sandbox: after it, LeRobot's ``make_env`` loads none of the
Hub's code into this process. ``lerobot-eval-sandboxed`` is ``lerobot-eval`` after ``install()``.
See ``docs/lerobot.md``.
"""

from __future__ import annotations

from envhub_sandbox.integrations.lerobot.config import SandboxedEnvConfig
from envhub_sandbox.integrations.lerobot.install import install

__all__ = ["SandboxedEnvConfig", "install"]
