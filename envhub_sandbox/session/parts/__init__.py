"""One environment over several workers: joins a session for each worker into one."""
