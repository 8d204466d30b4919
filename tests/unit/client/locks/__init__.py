"""Unit tests of ``envhub_sandbox/dependencies/locks``."""
