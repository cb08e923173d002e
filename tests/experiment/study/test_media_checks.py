"""A study whose media differ from stimuli.csv is not served."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from physion.cli.main import main
from physion.core.errors import BadInputError
from physion.experiment.study.media import check_media
from physion.experiment.study.study import Study, load_study
from physion.trials.video import encode_movie
from support.experiment.tiny_study import FULL, OBSERVED, draw, draw_map, make_tiny_study


@pytest.fixture
def study(tmp_path: Path) -> Study:
    return make_tiny_study(tmp_path, test=2, familiarization=2, size=64)


def test_a_right_study_passes(study: Study) -> None:
    check_media(study)


def test_a_movie_that_continues_is_refused(study: Study) -> None:
    path = study.folder / study.stimuli[-1].movie
    path.write_bytes(encode_movie(draw(3, False, 64)[: OBSERVED + 1]))
    with pytest.raises(BadInputError, match=r"46 frames; stimuli\.csv says 45") as raised:
        check_media(load_study(study.folder))
    assert str(path) in str(raised.value)


def test_it_is_not_served(study: Study, capsys: pytest.CaptureFixture[str]) -> None:
    (study.folder / study.stimuli[-1].movie).write_bytes(encode_movie(draw(3, False, 64)))
    assert main(["experiment", "serve", str(study.folder), "--port", "0"]) == 2
    assert f"{FULL} frames" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 44}, "has 45 frames; stimuli.csv says 44"),
        ({"width": 66}, "64 x 64 at 30"),
        ({"rate": 29.97}, "64 x 64 at 30"),
    ],
)
def test_rows_that_say_otherwise_are_refused(
    study: Study, change: dict[str, Any], message: str
) -> None:
    rows = (*study.stimuli[:-1], dataclasses.replace(study.stimuli[-1], **change))
    with pytest.raises(BadInputError, match=message):
        check_media(dataclasses.replace(study, stimuli=rows))


@pytest.mark.parametrize("content", [b"", b"no movie", draw_map(0, 64)])
def test_what_is_no_movie_is_refused(study: Study, content: bytes) -> None:
    (study.folder / study.stimuli[0].full).write_bytes(content)
    with pytest.raises(BadInputError, match="movie"):
        check_media(study)


@pytest.mark.parametrize("content", [b"", b"no map", draw_map(0, 32)])
def test_what_is_no_map_is_refused(study: Study, content: bytes) -> None:
    (study.folder / study.stimuli[0].map).write_bytes(content)
    with pytest.raises(BadInputError, match="map"):
        check_media(study)
