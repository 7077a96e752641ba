"""Planning of machines: failure arithmetic, choice by price and latency, and replay of recorded traces."""
