"""The item of mental rotation that ships: its figures, its picture and its right answer."""

from __future__ import annotations

import importlib.util
import tomllib
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from physion.experiment.study.settings import MENTAL_ROTATION
from physion.experiment.study.texts import shipped_languages, shipped_question
from support.paths import ROOT


@pytest.fixture(scope="module")
def drawing() -> ModuleType:
    """The script that drew the picture."""
    spec = importlib.util.spec_from_file_location("drawing", ROOT / "docs/mental_rotation.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_one_option_is_the_figure_and_no_turn_makes_it_of_its_mirror_image(
    drawing: ModuleType,
) -> None:
    assert drawing.RIGHT == MENTAL_ROTATION.right == "c"
    assert [mirrored for mirrored, _ in drawing.OPTIONS.values()].count(False) == 1
    assert drawing.is_chiral(drawing.CUBES)
    assert not drawing.is_chiral(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.0]]))


def test_every_cube_is_seen_in_every_figure(drawing: ModuleType) -> None:
    for mirrored, turn in [(False, drawing.VIEW), *drawing.OPTIONS.values()]:
        ids = drawing.render_figure(mirrored, turn, 96).ids
        assert np.bincount(ids.ravel(), minlength=11)[1:].min() > 50
        border = np.concatenate([ids[0], ids[-1], ids[:, 0], ids[:, -1]])
        assert not border.any()  # no figure is cut


@pytest.mark.slow
def test_the_picture_is_the_one_that_the_script_draws(drawing: ModuleType) -> None:
    shipped = np.asarray(Image.open(drawing.PICTURE).convert("RGB")).astype(int)
    drawn = np.asarray(drawing.draw()).astype(int)
    assert np.abs(shipped - drawn).mean() < 0.5


def test_it_has_texts_in_every_language() -> None:
    for language in shipped_languages():
        text = shipped_question("mental_rotation", f"{language}.toml").decode()
        own = tomllib.loads(text)["question"]["mental_rotation"]
        assert set(own) == {"text", "alt", "options"} and len(own["options"]) == 4
