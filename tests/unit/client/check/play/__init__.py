"""Unit tests of ``envhub_sandbox/check/play``."""
