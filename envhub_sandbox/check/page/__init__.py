"""The page for people: its parts, and how text gets into it."""
