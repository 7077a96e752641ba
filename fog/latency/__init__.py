"""Latency of regions: a probe of each region's endpoint, cached results, and stated values that override them.

``config`` is ``latency:`` of ``fog.yaml``; ``probe`` measures; ``known`` stores and merges.
"""
