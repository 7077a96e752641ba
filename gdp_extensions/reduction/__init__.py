"""Reductions of messages: what a proxy does to a message so that fewer bytes leave."""
