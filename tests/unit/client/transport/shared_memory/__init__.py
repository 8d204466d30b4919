"""Unit tests of ``envhub_sandbox/transport/shared_memory``."""
