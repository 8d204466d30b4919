"""Ways out to a network: sockets, names, frames, and services of this machine."""
