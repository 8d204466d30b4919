"""The places that a worker can run in: one file each, one protocol in ``base``."""
