"""Unit tests of ``envhub_sandbox/extras/sources``."""
