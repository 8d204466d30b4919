"""What programs write, as CI systems, terminals and browsers read it."""
