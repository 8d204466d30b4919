"""Access for clients on other hosts: keys, quotas, uploads, and the commands of ``listen``."""
