"""Cloth: sheets of particles that fall on rigid bodies whose motion is given."""
