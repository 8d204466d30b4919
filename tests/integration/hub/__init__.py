"""Downloads from a Hub on loopback, honest and lying."""
