"""Unit tests of ``envhub_sandbox/locks``."""
