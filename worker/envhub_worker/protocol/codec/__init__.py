"""Values to frames and back; docs/values.md is its document."""
