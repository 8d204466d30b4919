"""One suite that every way of running an environment has to pass."""
