"""Baselines: simple models that show what the score of another model is worth.

Each stands for one explanation of a score: knowing the outcome, answering like most people, a
statistical shortcut, motion without forces, or the position of coloured blobs. They compute with
numpy and scikit-learn only and need no torch.
"""
