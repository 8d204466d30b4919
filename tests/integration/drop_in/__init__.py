"""Code of other libraries runs on the proxy as on an environment of this process."""
