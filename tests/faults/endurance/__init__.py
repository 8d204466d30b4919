"""Programs that run for an hour, each with a short form that is a test."""
