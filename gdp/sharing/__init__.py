"""Sharing of names between the nodes of a domain: rules and delegations of a live proxy, offers, renewal."""
