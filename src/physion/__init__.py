"""Physion: physical scenes, people and models. Will the red object touch the yellow one?"""

from physion.version import __version__
