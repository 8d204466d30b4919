"""What people read: the terminal, warnings, the server's log, pages."""
