"""What is read of a repository without running any of it."""
