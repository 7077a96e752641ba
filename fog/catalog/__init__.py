"""What machines there are and what they cost, without asking anybody; and what was measured of spot machines.

Place: data and its loaders; reads files of this package only, on first use.
"""
