"""How servers and jails start, stay, are interrupted and end."""
