"""Views to curves: one file a method, one registry."""

from tubesight.methods.registry import METHODS, Method

__all__ = ["METHODS", "Method"]
