"""Physion: physical scenes, people and models. Will the red object touch the yellow one?"""

__version__ = "0.1.0"
