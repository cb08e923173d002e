"""The settings of a study in one of its conditions."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from physion.experiment.study.study import Study

_OF_TIMING = ("cue_ms", "flash_hz", "break_every")


class StudyKey:
    """Cache key of a study, compared by object identity, since studies are not hashable."""

    __slots__ = ("study",)

    def __init__(self, study: Study) -> None:
        self.study = study

    def __hash__(self) -> int:
        return id(self.study)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StudyKey) and self.study is other.study


def under(study: Study, condition: str | None) -> Study:
    """Return a study with the settings of a condition; the study itself for None.

    A preview may have a condition that the study no longer has: it keeps the study's settings.
    """
    return _under(StudyKey(study), condition) if condition else study


def variants(study: Study) -> tuple[Study, ...]:
    """Return the study under each of its conditions; the study itself if it has none."""
    return tuple(under(study, each.name) for each in study.conditions) or (study,)


# Cached because every request needs the settings of its session, whose object is a cache key too.
@lru_cache(maxsize=1024)
def _under(key: StudyKey, name: str) -> Study:
    study = key.study
    for condition in study.conditions:
        if condition.name == name:
            break
    else:
        return study
    own = {k: getattr(condition, k) for k in _OF_TIMING if getattr(condition, k) is not None}
    feedback = condition.familiarization_feedback
    return replace(
        study,
        condition=name,
        timing=replace(study.timing, **own),
        scenarios=condition.scenarios or study.scenarios,
        familiarization_feedback=study.familiarization_feedback if feedback is None else feedback,
    )
