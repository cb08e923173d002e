"""Version of the package, which is stored with everything that it makes."""

__version__ = "0.1.0"
