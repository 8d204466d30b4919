"""Unit tests of the client, one module at a time, in the folders of its packages."""
