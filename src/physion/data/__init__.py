"""Facts of the original study that ship with the package: scenes, outcomes, people, results."""

from physion.data.official import PACKAGED, OfficialData, official

__all__ = ["PACKAGED", "OfficialData", "official"]
