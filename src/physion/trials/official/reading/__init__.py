"""Import of official files: scenes, motions, labels and movies."""
