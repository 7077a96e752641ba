"""Capsules: named, signed, append-only logs of sealed messages, which a holder keeps and cannot read.

Sans-I/O. Source: N. Mor and others, *Global Data Plane: A Federated Vision for Secure Data in Edge Computing*, ICDCS
2019. ``docs/reference/capsule.md`` gives each byte.
"""
