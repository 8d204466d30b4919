"""Unit tests of ``envhub_sandbox/cli/shared``."""
