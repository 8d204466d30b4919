"""Messages to a worker server and to its runners. Knows no environment."""
