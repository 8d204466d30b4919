"""Other libraries' faces of a sandboxed environment, one module a library; each imports its own."""
