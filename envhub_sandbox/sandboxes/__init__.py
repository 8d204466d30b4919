"""The places that a worker can run in: one file each, and what each answers in ``sandbox``."""
