"""Unit tests of ``envhub_sandbox/vector``."""
