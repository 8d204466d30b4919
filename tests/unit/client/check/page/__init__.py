"""Unit tests of ``envhub_sandbox/check/page``."""
