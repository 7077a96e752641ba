"""Demonstration of a robot's memory; ``scripts/memory_demo.sh`` runs it."""
