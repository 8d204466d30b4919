"""``sandbox="ray"``: worker servers on the nodes of a Ray cluster, where Ray places them."""
