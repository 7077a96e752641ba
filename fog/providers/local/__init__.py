"""Machines on this one: network namespaces with processes of their own, which can be taken, killed, held or slowed."""
