"""The jails of a server: opened, asked, watched and ended."""
