"""Unit tests of ``envhub_sandbox/transport/values``."""
