"""physion view --predictions: what models imagine, as plain arrays for the viewer."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from physion.cli.main import main
from physion.clips.clips import whole_source
from physion.models.build import build_model
from physion.readout.imagined import imagine_with
from physion.trials.dataset import Dataset
from support.viewer_dataset import Plan, make_dataset

STANDSTILL = '''
"""A simulator in which everything stays where it is; half of its futures have a contact."""
import numpy as np
from physion.models import Provenance, Rollout, Spec


class Standstill:
    spec = Spec(inputs=("state",), stride=3, context=15, future=0, context_at="end")
    reader, samples, seed, arguments = "touch", 4, 0, {}
    dtype = np.float32

    def provenance(self):
        return Provenance("standstill", "none")

    def digest(self):
        return "0" * 64

    def imagine(self, context, samples, seed, **arguments):
        assert arguments == {"show": 1.0}
        places = [motion.trajectory.positions[44] for motion in context.state]
        assert all(len(motion.trajectory) == 45 for motion in context.state)
        most = max(len(place) for place in places)
        particles = np.full((len(places), samples, 5, most, 3), np.nan, self.dtype)
        things = np.full((len(places), most), -1)
        for row, place in enumerate(places):
            particles[row, :, :, : len(place)] = place
            things[row, : len(place)] = np.arange(len(place))
        gap = np.tile([0.5, -0.1, 0.2, 0.0], (len(places), 1))
        return Rollout(gap=gap, shown={"particles": particles, "things": things})


class Rough(Standstill):
    dtype = np.float64


class Greedy(Standstill):
    def imagine(self, context, samples, seed, **arguments):
        if len(context) > 1:
            raise MemoryError
        return super().imagine(context, samples, seed, **arguments)


class Silent(Standstill):
    def imagine(self, context, samples, seed, **arguments):
        return Rollout(gap=np.zeros((len(context), samples)))


class Uneven(Standstill):
    def imagine(self, context, samples, seed, **arguments):
        boxes = np.zeros((len(context), samples, 5, 2, 4), np.float32)
        slots = np.zeros((len(context), samples, 4, 2, 3), np.float32)
        return Rollout(shown={"boxes": boxes, "slots": slots})


class Answers:
    spec = Standstill.spec
    provenance, digest = Standstill.provenance, Standstill.digest
    answers = "observed"

    def predict(self, batch):
        return np.zeros(len(batch))
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_dataset(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "still.py"
    path.write_text(STANDSTILL)
    return path


def test_a_model_gives_plain_arrays_of_its_first_future(folder: Path, file: Path) -> None:
    dataset = Dataset(folder)
    imagined = imagine_with(dataset, [f"{file}:Standstill"], {})(["drop_0", "drape_0"])
    (ball,), (cloth,) = imagined["drop_0"], imagined["drape_0"]
    assert (ball.model, ball.weights, ball.futures) == ("standstill", "no weights", 4)
    assert ball.frames.tolist() == [47, 50, 53, 56, 59]
    assert ball.shown["particles"].shape == cloth.shown["particles"].shape == (5, 3, 3)
    truth = dataset.trial("drop_0").trajectory.positions[44]
    assert np.array_equal(ball.shown["particles"], np.stack([truth] * 5))
    assert cloth.shown["things"].tolist() == [0, 1, -1]
    # Two of four futures touch; the gap is that of the first, which is shown.
    assert ball.probability == pytest.approx(2.5 / 5) and ball.gap == 0.5


def test_pictures_come_with_what_was_seen_and_what_is_true(folder: Path) -> None:
    """The grey of a frame of the movies is 40 plus three times its number."""
    imagined = imagine_with(Dataset(folder), ["copy-last-frame"], {})(["drop_0", "drape_0"])
    for (one,) in imagined.values():
        assert one.model == "copy-last-frame" and one.weights == "no weights"
        assert one.seen_frames.tolist() == list(range(2, 45, 6)) and set(one.seen) == {"rgb"}
        assert one.frames.tolist() == [50, 56, 62]
        seen, true, copied = (
            values["rgb"].mean(axis=(1, 2, 3)) for values in (one.seen, one.true, one.shown)
        )
        assert seen == pytest.approx(40 + 3 * one.seen_frames, abs=3)
        # The last step is after the end of the movie, whose last frame stays.
        assert true == pytest.approx(40 + 3 * np.minimum(one.frames, 59), abs=3)
        assert copied == pytest.approx(np.full(len(one.frames), seen[-1]))
        assert np.isnan(one.gap) and np.isnan(one.probability)


def test_trials_that_memory_cannot_hold_together_are_imagined_one_by_one(
    folder: Path, file: Path
) -> None:
    trials = ["drop_0", "drape_0"]
    alone = imagine_with(Dataset(folder), [f"{file}:Greedy"], {})(trials)
    together = imagine_with(Dataset(folder), [f"{file}:Standstill"], {})(trials)
    for trial in trials:
        (one,), (other,) = alone[trial], together[trial]
        np.testing.assert_array_equal(
            one.shown["particles"], other.shown["particles"][:, : one.shown["particles"].shape[1]]
        )


SHOWN = {
    "svg": ({"rgb"}, {"rgb"}, {"rgb"}),
    "op3": ({"rgb", "masks"}, {"rgb"}, {"rgb", "masks"}),
    "rpin": ({"rgb", "boxes"}, {"rgb"}, {"boxes"}),
    "cswm": ({"rgb", "masks", "slots"}, {"rgb", "slots"}, {"slots"}),
}
"""What is shown of frames that were seen, of true ones after them, and of imagined ones."""


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SHOWN))
def test_vision_models_show_what_they_saw_and_imagined(folder: Path, name: str) -> None:
    model: Any = build_model(name, weights="shipped")
    dataset = Dataset(folder)
    (one,) = imagine_with(dataset, [name], {"weights": "shipped"})(["drop_0"])["drop_0"]
    assert one.weights == f"weights {model.init}"
    spec, parts = model.spec, (one.seen, one.true, one.shown)
    assert tuple(map(set, parts)) == SHOWN[name]
    seen = [44 - spec.stride * i for i in range(spec.context)]
    assert one.seen_frames.tolist() == seen[::-1] and seen[-1] < spec.stride
    # On to the first step that is not before the last frame.
    last = len(dataset.trial("drop_0").trajectory) - 1
    assert one.frames.tolist() == list(range(44 + spec.stride, last + spec.stride, spec.stride))
    # Exactly what the model imagines of the same frames.
    context = whole_source(dataset, spec).context(("drop_0",)).to("cpu")
    context = replace(context, future=len(one.frames))
    with torch.no_grad():
        imagined = model.eval().imagine(context, 1, 0, show=1.0).shown
    for key, values in one.shown.items():
        np.testing.assert_array_equal(values, np.asarray(imagined[key])[0, 0])


def test_trials_without_movies_are_rendered(tmp_path: Path) -> None:
    folder = make_dataset(tmp_path / "set", (Plan("state", movies=False),))
    (one,) = imagine_with(Dataset(folder), ["copy-last-frame"], {})(["state"])["state"]
    assert one.seen["rgb"].std() > 10 and one.true["rgb"].std() > 10


@pytest.mark.slow
def test_the_weights_of_particle_models_are_named(folder: Path) -> None:
    imagined = imagine_with(Dataset(folder), ["dpi"], {"weights": "random"})(["drop_0", "drape_0"])
    for trial, name, agent in (("drop_0", "ball", 0), ("drape_0", "sheet", 2)):
        (one,) = imagined[trial]
        assert one.model == "dpi-small" and one.weights == "untrained, weights random"
        assert one.probability in (0, 1) and np.isfinite(one.gap), name
        assert (one.shown["things"] == agent).sum() > 10
        assert one.frames[0] == 47 and len(one.frames) == len(one.shown["particles"])


@pytest.mark.slow
def test_the_verb_puts_them_into_the_page(folder: Path, file: Path, tmp_path: Path) -> None:
    out = tmp_path / "v.html"
    wanted = ["--trials", "1", "--details", "1", "--scenario", "drape"]
    models = ["--predictions", f"{file}:Standstill", "dpi", "--out", str(out)]
    assert main(["view", str(folder), *wanted, *models]) == 0
    (text,) = re.findall(r'id="detail-0">(.*?)</script>', out.read_text())
    first, second = json.loads(text)["imagined"]
    assert first["caption"].startswith("standstill (no weights): P(contact) 0.50 from 4 futures")
    assert second["caption"].startswith("dpi-small (weights shipped:")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--predictions", "{}:Silent"], "nothing that can be shown: .* features or outcomes"),
        (["--predictions", "{}:Uneven"], r"slots as float32 \(1, 4, 4, 2, 3\), expected"),
        (["--predictions", "{}:Rough"], r"particles as float64 .*, expected float32"),
        (["--predictions", "{}:Answers"], "imagines no future .* such as dpi"),
        (["--predictions", "dpi", "dpi"], "names a model twice: dpi-small, dpi-small"),
        (["--predictions", "dpi", "--details", "0"], "--details must be at least 1"),
        (["--option", "samples=4"], "names none"),
        (["--predictions", "dpii"], "unknown model 'dpii'; closest: dpi"),
        (["--predictions", "dpi", "--option", "sample=4"], "'sample'; closest: samples"),
    ],
)
def test_errors_are_one_clear_line(
    folder: Path, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    arguments: list[str], message: str,
) -> None:  # fmt: skip
    out = tmp_path / "v.html"
    given = [argument.format(file) for argument in arguments]
    assert main(["view", str(folder), "--scenario", "drape", "--out", str(out), *given]) == 2
    printed = capsys.readouterr().err
    assert re.search(message, printed), printed
    assert printed.strip().count("\n") == 0 and not out.exists()
