"""Unit tests of ``envhub_worker/extras/access/store``."""
