"""Journal of a node's core: kept in memory, saved as an incident, replayed. Sans-I/O."""
