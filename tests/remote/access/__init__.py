"""Who may come in on a TCP port, and what a client may have there."""
