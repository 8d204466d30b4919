"""Programs of the client on macOS and on Windows, as far as Linux can pretend to be one."""
