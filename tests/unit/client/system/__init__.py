"""Unit tests of ``envhub_sandbox/system``."""
