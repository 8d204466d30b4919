"""One environment's life in jails: opened, asked, survived, closed. Knows no Gymnasium face."""
