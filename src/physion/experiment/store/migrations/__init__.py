"""Versions of the tables, one file each, applied in order when a study is served."""
