"""Unit tests of ``envhub_sandbox/hub/sources``."""
