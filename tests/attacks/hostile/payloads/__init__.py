"""One file per attack: ``attack(**arguments)`` returns what it got, or raises."""
