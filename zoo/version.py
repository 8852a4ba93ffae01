"""The version of this package, as every stored result names it."""

__all__ = ["__version__"]

__version__ = "0.1.0"
