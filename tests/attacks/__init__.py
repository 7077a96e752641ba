"""Attacks that once worked; each test is named after its number in the threat model."""
