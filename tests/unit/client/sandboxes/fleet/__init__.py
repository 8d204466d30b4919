"""The places of a fleet, one module at a time."""
