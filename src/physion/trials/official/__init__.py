"""The original study's files: export to them and import from them."""
