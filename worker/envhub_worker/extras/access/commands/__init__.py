"""Commands of ``envhub-worker``, one module each, and helpers of ``listen``."""
