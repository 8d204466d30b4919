"""What an operator reads: lines of a log, and figures."""
