"""Models in a user's file: the examples run, and what is wrong with one is told in one line."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import physion
from physion.cli.main import main
from physion.compute.local import LocalExecutor, SerialExecutor
from physion.core.errors import BadInputError, PhysionError
from physion.models import Batch
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings, TrainSettings
from physion.trials.dataset import Dataset
from physion.trials.making.plan import GenerateSettings
from support.moving_dots import make_dots
from support.paths import ROOT

EXAMPLES = ROOT / "examples" / "my_model"
QUICK = EvaluationSettings(folds=2, accelerator="cpu", logistic=LogisticSettings(grid=(1e-2, 1.0)))


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_dots(tmp_path_factory.mktemp("dots"), {"readout": 4, "testing": 4}, ("drop",))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    settings = GenerateSettings(width=64, height=64, look="redyellow", jitters=0)
    return physion.generate(
        tmp_path_factory.mktemp("made") / "data",
        "collide",
        4,
        settings=settings,
        executor=SerialExecutor(),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "protocols"),
    [
        ("my_encoder.py:MyEncoder", {"observed", "full"}),
        ("my_dynamics.py:MyDynamics", {"observed", "observed+simulated", "full"}),
        ("my_rule.py:MyRule", {"observed"}),
    ],
)
def test_the_examples_predict_every_trial(
    name: str, protocols: set[str], made: Dataset, tmp_path: Path
) -> None:
    done = physion.evaluate(
        str(EXAMPLES / name), made, tmp_path, options={"steps": 5}, settings=QUICK
    )
    assert set(done.predictions["readout"]) == protocols and not done.problems
    assert len(done.predictions) == len(protocols) * len(made)
    assert done.predictions["p_contact"].between(0, 1).all()
    trained = "Dynamics" in name
    assert len(list(tmp_path.glob("training/*"))) == (QUICK.folds if trained else 0)


@pytest.mark.slow
def test_evaluation_finds_what_was_trained_before(made: Dataset, tmp_path: Path) -> None:
    model: Any = physion.build_model(f"{EXAMPLES / 'my_dynamics.py'}:MyDynamics", channels=4)
    initial = model.digest()
    few = {"steps": 5}
    settings = TrainSettings(folds=2, accelerator="cpu")
    trained = physion.train(model, made, tmp_path, options=few, settings=settings).trained
    assert len(trained) == 2 and not any(result.loaded for result in trained)
    assert model.digest() == initial, "the weights stay the initial ones"
    again = physion.train(model, made, tmp_path, options=few, settings=settings).trained
    assert all(result.loaded for result in again)
    steps: list[str] = []
    done = physion.evaluate(
        model, made, tmp_path, options=few, settings=QUICK,
        progress=lambda what, *rest: steps.append(what),
    )  # fmt: skip
    assert "observed+simulated" in set(done.predictions["readout"])
    assert not [what for what in steps if what.startswith("training")]
    assert model.digest() == initial, "the weights are the initial ones again"
    for function in (physion.train, physion.evaluate):
        with pytest.raises(BadInputError, match="options are for a model that is given by its"):
            function(model, made, tmp_path, options={"channels": 4})  # type: ignore[operator]


def test_the_rule_follows_the_gap_of_the_boxes() -> None:
    rule: Any = physion.build_model(f"{EXAMPLES / 'my_rule.py'}:MyRule", scale=0.5)
    boxes = np.zeros((3, 1, 2, 4), np.float32)
    boxes[:, :, 0] = (0.0, 0.0, 0.2, 0.2)
    boxes[0, :, 1] = (0.1, 0.1, 0.3, 0.3)  # overlap
    boxes[1, :, 1] = (0.5, 0.6, 0.7, 0.7)  # 0.3 to the right, 0.4 below: 0.5 apart
    boxes[2, :, 1] = np.nan
    frames = np.full((3, 1), 44)
    answers = rule.predict(Batch(("a", "b", "c"), frames, frames > 0, boxes=boxes))
    assert answers == pytest.approx([1.0, np.exp(-1.0), 0.5], abs=1e-6)
    assert rule.digest() != physion.build_model(f"{EXAMPLES / 'my_rule.py'}:MyRule").digest()


HEAD = """
import numpy as np
from physion.models import Provenance, Rollout, Spec

class Model:
    spec = Spec(image_size=16, context=2, future=1)
    def provenance(self):
        return Provenance("mine", "none")
    def digest(self):
        return "0" * 64
"""
ENCODES = "    def encode(self, batch):\n        clips, steps = batch.rgb.shape[:2]\n        "
PREDICTS = '    answers = "observed"\n    def predict(self, batch):\n        '
IMAGINES = (
    '    decision = "gap"\n    samples, seed, arguments = 2, 0, {}\n'
    "    def imagine(self, context, samples, seed, **arguments):\n"
    "        clips = len(context)\n        "
)
WRONG = {
    "encode raises": (ENCODES + "raise ValueError('two\\nlines')",
        r"model 'mine': encode raised ValueError: two lines \(model.py, line 13\)"),
    "predict raises": (PREDICTS + "return batch.boxes.sum()",
        "model 'mine': predict raised AttributeError: 'NoneType' object has no attribute 'sum'"),
    "predict has a wrong shape": (PREDICTS + "return np.zeros((len(batch), 2))",
        r"predict gave probabilities as float64 \(\d, 2\), expected float64 \(\d\)"),
    "predict is no probability": (PREDICTS + "return np.full(len(batch), 1.5)",
        r"predict gave 1\.5, not a probability"),
    "predict is not finite": (PREDICTS + "return np.full(len(batch), np.inf)",
        r"predict gave probabilities that are not finite \(inf\); check"),
    "no capability": ("    pass",
        "mine has none of the methods encode, imagine, predict and fit"),
    "digest raises": ("    encode = None\n    def digest(self): return open('none').read()",
        r"model 'Model': digest raised FileNotFoundError: .*\(model.py, line 12\)"),
    "digest is a number": ("    def digest(self): return 7",
        "model 'Model': digest gave 7, expected a str"),
    "provenance is a name": ("    def provenance(self): return 'mine'",
        "model 'Model': provenance gave 'mine', expected a Provenance"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", WRONG)
def test_what_a_model_does_wrong_is_an_error_that_says_it(
    case: str, dots: Dataset, tmp_path: Path
) -> None:
    body, message = WRONG[case]
    (tmp_path / "model.py").write_text(f"{HEAD}{body}\n")
    with pytest.raises(PhysionError, match=message):
        physion.evaluate(f"{tmp_path / 'model.py'}:Model", dots, tmp_path / "out", settings=QUICK)
    assert not list(tmp_path.rglob("*.csv"))


def test_the_command_line_says_it_in_one_line(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    body, message = WRONG["encode raises"]
    (tmp_path / "model.py").write_text(f"{HEAD}{body}\n")
    model, out = f"{tmp_path / 'model.py'}:Model", str(tmp_path / "out")
    assert main(["evaluate", model, str(dots.folder), "--out", out]) == 2
    (error,) = capsys.readouterr().err.strip().splitlines()
    assert error.startswith("physion: ") and re.search(message, error), error


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import not_there_at_all", "needs the library 'not_there_at_all', which is not installed"),
        ("x = 1\n1 / 0", r"model.py, line 2 raised ZeroDivisionError"),
        ("def Model(:", r"model.py, line 1 raised SyntaxError: [^(]*$"),
        ("class Modell: pass", "unknown name in .*model.py 'Model'; closest: Modell"),
        ("class Model:\n  def __init__(self): import no_such_library", "library 'no_such_library'"),
        (
            "class Model:\n  def __init__(self):\n    raise OSError('no weights')",
            r"building it raised OSError: no weights \(model.py, line 3\)",
        ),
        ("class Model:\n  def __init__(self, size): pass", "building it raised TypeError.*size"),
        ("class Model: pass", "lacks spec, provenance, digest; see docs/tutorials/own-model.md"),
        (
            "class Model:\n  spec = {}\n  provenance = digest = print",
            "spec is a dict, expected a Spec",
        ),
        (
            "from physion.models import Spec\n"
            "class Model:\n  spec = Spec()\n  provenance, digest = print, 'abc'",
            "digest must be a method",
        ),
    ],
)
def test_what_cannot_be_built_is_reported(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "model.py").write_text(text)
    with pytest.raises(PhysionError, match=message):
        physion.build_model(f"{tmp_path / 'model.py'}:Model")


def test_files_and_names_that_are_not_there_are_reported(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="there is no file"):
        physion.build_model(f"{tmp_path / 'none.py'}:Model")
    (tmp_path / "model.py").write_text("class Model: pass")
    with pytest.raises(BadInputError, match=r"write .*model.py:NameOfTheClass"):
        physion.build_model(str(tmp_path / "model.py"))


def test_an_edited_file_is_another_model(tmp_path: Path) -> None:
    path = tmp_path / "my_encoder.py"
    shutil.copy(EXAMPLES / "my_encoder.py", path)
    first = physion.build_model(f"{path}:MyEncoder")
    assert physion.build_model(f"{path}:MyEncoder").digest() == first.digest()
    path.write_text(path.read_text().replace("/ 255", "/ 128"))
    second = physion.build_model(f"{path}:MyEncoder")
    before = first.digest()
    assert type(second) is not type(first) and second.digest() != before
    assert first.digest() == before, "what is loaded stays as it was"


def test_the_digest_covers_base_classes_in_other_files(tmp_path: Path) -> None:
    digests = []
    for number, scale in enumerate((255, 128)):
        folder = tmp_path / str(number)
        shutil.copytree(EXAMPLES, folder)
        base = folder / f"base_{number}.py"
        (folder / "my_encoder.py").rename(base)
        base.write_text(base.read_text().replace("/ 255", f"/ {scale}"))
        dynamics = folder / "my_dynamics.py"
        dynamics.write_text(dynamics.read_text().replace("from my_encoder", f"from {base.stem}"))
        digests.append(physion.build_model(f"{dynamics}:MyDynamics").digest())
    assert digests[0] != digests[1]


def test_the_digest_of_a_class_without_a_file_covers_its_code() -> None:
    def digest(step: int) -> str:
        names: dict[str, Any] = {"__name__": "a notebook"}
        exec(
            "from physion.models import Spec\n"
            "from physion.models.torch_model import TorchModel\n"
            "class Model(TorchModel):\n"
            "    spec = Spec()\n"
            f"    def encode(self, batch): return batch.rgb[..., ::{step}]\n",
            names,
        )
        return str(names["Model"]().digest())

    assert digest(1) == digest(1) != digest(2)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_simulator_in_a_file_runs_in_worker_processes(
    dots: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if its file was edited after it was loaded: the workers get what was loaded."""
    body = IMAGINES + "return Rollout(gap=np.full((clips, samples), helper.GAP))"
    (tmp_path / "helper.py").write_text("GAP = 0.25\n")
    path = tmp_path / "model.py"
    path.write_text(f"import helper\n{HEAD}{body}\n")
    model = physion.build_model(f"{path}:Model")
    path.write_text("raise ValueError")
    evaluation = physion.evaluate(
        model, dots, tmp_path / "out", executor=LocalExecutor(workers=2), settings=QUICK
    )
    assert not evaluation.problems and len(evaluation.predictions) == 4
    assert evaluation.predictions["p_contact"].nunique() == 1


EXTRACTOR = """
import numpy as np
import torch

class Extractor(torch.nn.Module):
    def __init__(self, gap=150, least=4, bias=0.0):
        super().__init__()
        self.gap, self.least = gap, least
        self.bias = torch.nn.Parameter(torch.full((3,), bias))

    def transform(self):
        def change(pictures):
            assert [picture.mode for picture in pictures] == ["RGB"] * len(pictures)
            stacked = np.concatenate([np.array(p.resize((8, 8))) for p in pictures], axis=2)
            return torch.from_numpy(stacked).permute(2, 0, 1).float() / 255
        return change, self.gap, self.least

    def extract_features(self, videos):
        assert videos.shape[1:] == (4, 3, 8, 8), videos.shape
        return videos.mean((3, 4)) + self.bias
"""


@pytest.fixture
def extractor(tmp_path: Path) -> str:
    (tmp_path / "extractor.py").write_text(EXTRACTOR)
    return f"{tmp_path / 'extractor.py'}:Extractor"


def test_an_extractor_of_the_other_evaluator_becomes_a_model(
    extractor: str, dots: Dataset, tmp_path: Path
) -> None:
    done = physion.evaluate(extractor, dots, tmp_path / "out", settings=QUICK)
    assert set(done.predictions["readout"]) == {"observed"}
    assert set(done.predictions["model"]) == {"Extractor"}
    assert done.predictions["init"].str.fullmatch("local:[0-9a-f]{64}").all()
    assert len(done.predictions) == 4 and not done.problems


def test_an_extractor_sees_the_last_observed_frames_at_its_gap(extractor: str) -> None:
    model: Any = physion.build_model(extractor)
    assert model.spec.context_frames() == (14, 29, 44) and model.spec.future == 0
    assert physion.build_model(extractor, gap=33).spec.stride == 4, "33 ms are 4 frames or less"
    assert len(physion.build_model(extractor, gap=33).spec.context_frames()) == 12
    rgb = np.zeros((2, 3, 256, 256, 3), np.uint8)
    rgb[:, 0], rgb[:, 1], rgb[1, 2] = 51, 102, 255
    frames = np.tile([14, 29, 44], (2, 1))
    features = model.encode(Batch(("a", "b"), frames, frames > 0, rgb=rgb).to("cpu"))
    assert features.shape == (2, 1, 4 * 3)
    shown = [0.2, 0.2, 0.4, 0.0], [0.2, 0.2, 0.4, 1.0]
    assert np.allclose(features[:, 0].detach().numpy(), np.repeat(shown, 3, axis=1))


def test_the_digest_of_an_extractor_follows_source_weights_and_gap(
    extractor: str, tmp_path: Path
) -> None:
    options: list[dict[str, Any]] = [{}, {"bias": 1.0}, {"gap": 140}, {"least": 5}]
    digests = [physion.build_model(extractor, **given).digest() for given in options]
    (tmp_path / "extractor.py").write_text(EXTRACTOR.replace("/ 255", "/ 128"))
    digests.append(physion.build_model(extractor).digest())
    assert len(set(digests)) == 5
    first, second = (physion.build_model(extractor, bias=b).provenance().init for b in (0.0, 1.0))
    assert first != second


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("(torch.nn.Module)", "", "is not a torch"),
        ("return change, self.gap, self.least", "return change", "expected a transform, the gap"),
        ("self.gap, self.least\n\n", "self.gap, 0\n\n", "expected a transform, the gap"),
        ("change, self.gap", "change, 'slow'", "expected a transform, the gap"),
    ],
)
def test_a_wrong_extractor_is_reported_when_it_is_built(
    old: str, new: str, message: str, extractor: str, tmp_path: Path
) -> None:
    text = EXTRACTOR.replace(old, new)
    if "torch" in old:
        text = text.replace("super().__init__()", "pass").replace("torch.nn.Parameter", "")
    assert text != EXTRACTOR
    (tmp_path / "extractor.py").write_text(text)
    with pytest.raises(BadInputError, match=f"model 'Extractor'.*{message}"):
        physion.build_model(extractor)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "torch.from_numpy(stacked).permute(2, 0, 1).float() / 255",
            "stacked",
            "its transform gave ndarray",
        ),
        (
            "axis=2)\n",
            "axis=2)[..., :3]\n",
            r"its transform gave Tensor \(3, 8, 8\) for 3 pictures",
        ),
        ("return videos.mean((3, 4))", "return videos.mean(); ", "extract_features gave Tensor"),
        ("return videos.mean((3, 4))", "return videos.detach().numpy(); ", "gave ndarray"),
    ],
)
def test_what_an_extractor_returns_is_checked(
    old: str, new: str, message: str, extractor: str, dots: Dataset, tmp_path: Path
) -> None:
    assert old in EXTRACTOR
    (tmp_path / "extractor.py").write_text(EXTRACTOR.replace(old, new))
    with pytest.raises(BadInputError, match=message):
        physion.evaluate(extractor, dots, tmp_path / "out", settings=QUICK)
