"""What happens when things go wrong: the fault matrix, and what is left behind."""
