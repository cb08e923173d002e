"""What the vision models that are trained from pictures have in common."""
