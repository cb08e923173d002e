"""Export to and import from the file formats of the original study."""
