"""Unit tests of ``envhub_worker/protocol/spaces``."""
