"""How far regions are from here: a probe for each region's endpoint, its results kept for a while, and overridden.

``config`` is ``latency:`` of ``fog.yaml``; ``probe`` measures; ``known`` keeps and merges.
"""
