"""How a scene moves."""
