"""From scenes to trials on disk: plan, choose, make, verify."""
