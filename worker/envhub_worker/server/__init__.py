"""The worker server, between ZeroMQ clients and jails, and its gate."""
