"""Parts of a worker, or of a session, in this process."""
