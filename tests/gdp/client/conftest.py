"""Signatures of the tests of members."""

from tests.insiders.signatures import signatures

__all__ = ["signatures"]
