"""Training: clips, features, and dynamics that are trained on them."""
