"""The lane for workers on this machine: steps over memory that both sides map."""
