"""Unit tests of ``envhub_sandbox/session/survival``."""
