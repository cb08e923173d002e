"""Version of the package, which is stored with everything that it makes."""

__version__ = "0.1.0"
MADE_WITH = f"physion {__version__}"
"""Name of the package with its version, as it stands in files that the package writes."""
