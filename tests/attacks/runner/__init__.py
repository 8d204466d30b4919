"""A hostile runner: what it holds, does to what it shares with the client, and leaves behind."""
