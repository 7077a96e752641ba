"""Links of a node that are no cable: tunnels over UDP, relays over TLS, veth pairs of one host. I/O."""
