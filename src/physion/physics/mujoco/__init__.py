"""The second engine: rigid bodies by MuJoCo's own solver."""
