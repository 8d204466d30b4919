"""Unit tests of ``envhub_worker/protocol/messages``."""
