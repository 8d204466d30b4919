"""Unit tests of ``envhub_worker/access/store``."""
