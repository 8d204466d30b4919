"""One environment over several workers: a session for each, and what joins these into one."""
