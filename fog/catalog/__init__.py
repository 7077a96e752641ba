"""Catalogues of machine types with their prices, and measurements of spot machines; no network access.

I/O; reads only files of this package, on first use.
"""
