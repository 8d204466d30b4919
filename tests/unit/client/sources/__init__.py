"""Unit tests of ``envhub_sandbox/sources``."""
