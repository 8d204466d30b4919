"""What is seen while a repository is played for a verdict."""
