"""The places that a worker can run in: a file or folder each, and what each answers."""
