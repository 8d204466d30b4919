"""What an operator is told: lines of a log, and figures."""
