"""Unit tests of ``envhub_sandbox/factory``."""
