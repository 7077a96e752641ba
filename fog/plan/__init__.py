"""How many machines, which ones and where: failure arithmetic, choice by price and latency, replayed traces.

Sans-I/O.
"""
