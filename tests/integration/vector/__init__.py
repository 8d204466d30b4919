"""The vector environment and the single one, beyond what ``tests/compliance`` compares."""
