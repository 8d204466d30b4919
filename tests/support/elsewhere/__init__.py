"""A client on macOS and on Windows, as far as this machine can be one."""
