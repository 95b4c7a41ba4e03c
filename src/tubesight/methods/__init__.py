"""Views to curves: one file a method, one registry."""

from tubesight.methods.method import Method
from tubesight.methods.registry import METHODS

__all__ = ["METHODS", "Method"]
