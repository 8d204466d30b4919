"""Unit tests of ``envhub_worker/protocol/shared_memory``."""
