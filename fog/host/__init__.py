"""Agent of a cluster's machine, for every provider: it runs the programs of the bundle and reports their status."""
