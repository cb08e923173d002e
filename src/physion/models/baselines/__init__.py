"""Baselines: simple models that show what the score of another model is worth.

Each stands for one explanation of a score: a base rate, a statistical shortcut, motion without
forces, or the position of coloured blobs. They compute with numpy and scikit-learn only and need no
torch.
"""
