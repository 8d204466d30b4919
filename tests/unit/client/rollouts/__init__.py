"""Unit tests of ``envhub_sandbox/rollouts``."""
