"""What joins the workers of a fleet, one module at a time."""
