"""Commands of ``envhub-worker``, one file each, and what ``listen`` needs besides."""
