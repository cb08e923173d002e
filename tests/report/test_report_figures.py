"""Figures: they show the numbers of their tables, and their bytes do not depend on the day."""

from __future__ import annotations

import io
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.patches import Rectangle
from PIL import Image

from physion.analysis import Comparison
from physion.report import figures

Maker = Callable[..., Comparison]


def test_bars_are_as_long_as_the_accuracies(make_comparison: Maker) -> None:
    comparison = make_comparison()
    figure = figures.accuracy_figure(comparison)
    data = figures.accuracy_data(comparison)
    for axis, scenario in zip(figure.axes, ["collide", "drop", "mean"], strict=True):
        drawn = [
            p.get_width() for p in axis.patches if isinstance(p, Rectangle) and p.get_height() < 0.9
        ]
        assert drawn == pytest.approx(data[data["scenario"] == scenario]["accuracy"].tolist())
        people = comparison.people.set_index("scenario").loc[scenario, "accuracy"]
        assert any(np.allclose(line.get_xdata(), people) for line in axis.lines)
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    assert titles == ["collide", "drop", "mean over scenarios"]


def test_points_are_the_stimuli(make_comparison: Maker) -> None:
    comparison = make_comparison()
    figure = figures.scatter_figure(comparison)
    data = figures.scatter_data(comparison)
    for axis, agent in zip(figure.axes, comparison.agents, strict=False):
        points = np.concatenate([c.get_offsets() for c in axis.collections])
        own = data[data["agent"] == agent][["p_yes", "p_contact"]].to_numpy()
        assert np.allclose(np.sort(points, axis=0), np.sort(own, axis=0))


def test_readouts_differ_without_colour(make_comparison: Maker) -> None:
    kinds = figures._kinds(make_comparison())
    hatches = [hatch for _, hatch in kinds.values()]
    assert len(set(hatches)) == len(hatches) == 2


@pytest.mark.parametrize("theme", [figures.LIGHT, figures.DARK], ids=lambda theme: theme.name)
def test_marks_stand_out_from_the_paper(theme: figures.Theme) -> None:
    def brightness(colour: str) -> float:
        linear = [
            c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(colour)
        ]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    def contrast(one: str, other: str) -> float:
        dark, light = sorted((brightness(one), brightness(other)))
        return (light + 0.05) / (dark + 0.05)

    assert contrast(theme.ink, theme.paper) > 7
    assert contrast(theme.faint, theme.paper) > 3
    assert min(contrast(colour, theme.paper) for colour in theme.palette) > 1.5


@pytest.mark.parametrize("with_people", [True, False])
def test_figures_are_sound_files(make_comparison: Maker, with_people: bool) -> None:
    figure = figures.accuracy_figure(make_comparison(with_people=with_people))
    assert ElementTree.fromstring(figures.figure_bytes(figure, "svg")).tag.endswith("svg")
    image = Image.open(io.BytesIO(figures.figure_bytes(figure, "png")))
    assert image.width > 1000 and np.asarray(image.convert("L")).std() > 10


def test_bytes_repeat(make_comparison: Maker) -> None:
    for draw, kind in ((figures.accuracy_figure, "svg"), (figures.scatter_figure, "png")):
        one, two = (figures.figure_bytes(draw(make_comparison()), kind) for _ in range(2))
        assert one == two


def test_model_names_are_text_and_not_formulas(make_comparison: Maker) -> None:
    odd = make_comparison(model="$x_1$ <b> & co")
    labels = [t.get_text() for t in figures.accuracy_figure(odd).axes[0].get_yticklabels()]
    assert labels[0].startswith("$x_1$ <b>")
    assert figures.figure_bytes(figures.accuracy_figure(odd), "png")
