"""What LeRobot imports when it looks for plugins: registers ``--env.type=envhub_sandbox``."""

from envhub_sandbox.integrations.lerobot import SandboxedEnvConfig as SandboxedEnvConfig
