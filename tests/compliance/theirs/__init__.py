"""Other people's tests of vector environments, run through the sandbox."""
