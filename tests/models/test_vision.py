"""Every vision model that is trained from clips: what holds for all, errors, what they learn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from physion.clips.batch import Batch
from physion.core.errors import BadInputError
from physion.models.build import build_model
from physion.models.checkpoint import WEIGHTS, DamagedFileError, tensors_of, write_checkpoint
from physion.models.interface import TrainingSettings
from physion.models.op3 import Op3, Op3Settings
from physion.models.svg import Svg, SvgSettings
from physion.models.vision import (
    CHANGE,
    copy_error,
    empty_scene_error,
    future_error,
    gaussian_divergence,
    gaussian_values,
    moving_pixels,
)
from physion.readout.evaluate import evaluate
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings
from physion.training.train import train_model
from physion.training.windows import ClipWindows, validation_requests
from physion.trials.dataset import Dataset
from support.late_motions import make_late_motions
from support.leak_checks import with_exchanged_futures, with_permuted_labels
from support.moving_dots import make_dots
from support.moving_squares import BACKGROUND, squares, with_arrays
from support.squares_source import SquaresSource
from support.tiny_models import TINY

NAMES = ("cswm", "rpin", "svg", "op3")
FIRST = ("cswm", *(pytest.param(name, marks=pytest.mark.nightly) for name in NAMES[1:]))
"""For what is the same code in all: the nightly tests have the others."""
OF_PICTURES = ("svg", "op3")
"""Those that predict pictures."""
ENCODERS = {"pVGG": "test_resnet", "pDeIT": "test_vit", "pEffNetLite0": "test_efficientnet"}
"""Small encoders in place of those of the families with a frozen encoder."""
OVERFITTED = {
    "cswm": 60, "rpin": 40, "svg": 40, "op3": 12,
    **{f"{family}-{dynamics}": 150 for family in ENCODERS for dynamics in ("mlp", "lstm")},
}  # fmt: skip
"""Steps on one batch by model."""


def model_of(name: str, **options: Any) -> Any:
    return build_model(name, **{"weights": "random", **options}).eval()  # type: ignore[attr-defined]


def tiny_encoder(name: str) -> dict[str, Any]:
    """Return options that give a model of a family a small encoder with random weights."""
    encoder = ENCODERS.get(name.partition("-")[0])
    return {**TINY, "encoder": encoder} if encoder else {}


def context_of(model: Any, clips: int = 2, seed: int = 0) -> Batch:
    return squares(clips, model.spec.context, model.spec, seed)


@torch.no_grad()
def outputs(model: Any, context: Batch) -> tuple[Any, Any]:
    """Return the features of a context and those of its future."""
    features = model.encode(context)
    return features, model.imagine(with_arrays(context, features=features), 2, 0).features


@pytest.mark.parametrize("name", NAMES)
def test_features_of_context_and_future_have_one_size(name: str) -> None:
    model = model_of(name)
    context = context_of(model)
    features, future = outputs(model, context)
    assert features.dtype == future.dtype == torch.float32
    assert features.shape[:2] == (2, model.spec.context)
    assert future.shape == (2, 2, context.future, features.shape[-1])
    assert features.isfinite().all() and future.isfinite().all()
    assert not torch.equal(features[0], features[1]) and not torch.equal(future[0], future[1])


@pytest.mark.parametrize("name", NAMES)
def test_a_clip_does_not_depend_on_the_others_of_a_batch(name: str) -> None:
    model = model_of(name)
    batch = context_of(model, 3)
    for one, many in zip(outputs(model, batch.select([1])), outputs(model, batch), strict=True):
        assert torch.allclose(one[0], many[1], atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_without_stored_features_a_future_is_imagined_from_the_pictures(name: str) -> None:
    model = model_of(name)
    context = context_of(model)
    with torch.no_grad():
        from_pictures = model.imagine(context, 2, 0).features
    assert torch.equal(from_pictures, outputs(model, context)[1])


@pytest.mark.parametrize("name", NAMES)
def test_what_follows_the_context_changes_none_of_its_features(name: str) -> None:
    model = model_of(name)
    spec = model.spec
    whole = squares(2, spec.context + 4, spec)
    noise = np.random.default_rng(0)
    rgb = whole.rgb.clone()
    rgb[:, spec.context :] = torch.from_numpy(
        noise.integers(0, 256, rgb[:, spec.context :].shape, np.uint8)
    )
    poisoned = with_arrays(whole, rgb=rgb)
    if whole.boxes is not None:
        boxes = whole.boxes.clone()
        boxes[:, spec.context :] = boxes[:, spec.context :] * 0.3 + 0.5
        poisoned = with_arrays(poisoned, boxes=boxes)
    with torch.no_grad():
        clean, changed = model.encode(whole), model.encode(poisoned)
        alone = model.encode(whole.steps(slice(0, spec.context)))
    assert torch.equal(clean[:, : spec.context], changed[:, : spec.context])
    assert torch.allclose(alone, clean[:, : spec.context], atol=1e-5)
    assert not torch.equal(clean[:, spec.context :], changed[:, spec.context :])


@pytest.mark.parametrize("name", NAMES)
def test_the_seed_determines_the_weights_and_nothing_else_does(name: str) -> None:
    torch.manual_seed(1)
    one = model_of(name, seed=4)
    torch.manual_seed(2)
    same, other = model_of(name, seed=4), model_of(name, seed=5)
    assert one.digest() == same.digest() != other.digest()
    pairs = zip(outputs(one, context_of(one)), outputs(same, context_of(one)), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


def steps(model: Any, batch: Batch, count: int, rate: float = 2e-3) -> list[float]:
    """Train on one batch; return the losses."""
    model.train()
    optimizer = torch.optim.Adam(model.parameters(), rate)
    losses = []
    for step in range(count):
        torch.manual_seed(step)
        optimizer.zero_grad()
        loss = model.loss(batch)["loss"]
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    return losses


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), OVERFITTED.items())
def test_a_model_overfits_one_batch(name: str, count: int) -> None:
    """Dynamics of frozen encoders repeat the last feature at first, so that their first loss is
    that of the trivial predictor. Boxes of the squares go on at constant velocity, which is the
    trivial predictor of RPIN; the others are compared with theirs."""
    model = model_of(name, **tiny_encoder(name))
    batch = squares(4, model.window, model.spec)
    if model.learns_from == "features":
        batch = with_arrays(batch, features=model.encode(batch))
    model.prepare(batch)
    losses = steps(model, batch, count)
    assert np.mean(losses[-5:]) < 0.3 * losses[0]
    if name in ("cswm", "svg", "op3"):
        model.eval()
        with torch.no_grad():
            loss, trivial = float(model.loss(batch)["loss"]), float(model.baseline(batch))
        assert loss < (0.6 if name == "op3" else 0.2) * trivial


class Killed(Exception):
    """Stands for the end of a process."""


def train(model: Any, folder: Path, last: int = 4) -> Path:
    """Train for 4 steps with a checkpoint after 2; the process ends after step ``last``."""

    def end(what: str, done: int, total: int) -> None:
        if done == last < total:
            raise Killed

    source = SquaresSource(model.spec, 6)
    settings = TrainingSettings(steps=4, batch=2, log_every=2, checkpoint_every=2)
    result = train_model(
        model, source, source.trials, seed=1, name="all", folder=folder, settings=settings,
        accelerator="cpu", progress=end,
    )  # fmt: skip
    assert result.folder is not None
    return result.folder / WEIGHTS


@pytest.mark.slow
@pytest.mark.parametrize("name", FIRST)
def test_a_resumed_training_gives_the_bytes_of_an_uninterrupted_one(
    name: str, tmp_path: Path
) -> None:
    whole = train(model_of(name), tmp_path / "whole").read_bytes()
    with pytest.raises(Killed):
        train(model_of(name), tmp_path / "parts", last=3)
    assert not list((tmp_path / "parts").rglob(WEIGHTS))
    resumed = model_of(name)
    path = train(resumed, tmp_path / "parts")
    assert path.read_bytes() == whole
    loaded = model_of(name, weights=str(path.parent))
    assert loaded.trained and loaded.init.startswith("local:") and not resumed.trained
    assert loaded.digest() == resumed.digest() != model_of(name).digest()


def test_weights_of_another_architecture_are_refused_by_name(tmp_path: Path) -> None:
    model, other = model_of("svg"), model_of("cswm")
    path = tmp_path / "model.safetensors"
    write_checkpoint(path, tensors_of(model), {"built_as": {**model.built_as(), "model": "x"}})
    with pytest.raises(BadInputError, match="model was x and is svg-small"):
        model_of("svg", weights=str(path))
    write_checkpoint(path, tensors_of(other), {"built_as": other.built_as()})
    first = next(iter(model.state_dict()))
    with pytest.raises(BadInputError, match=rf"{first} is missing.*weights of this one$"):
        model_of("svg", weights=str(path))
    tensors = tensors_of(model)
    missing, *_, wider = (key for key, value in tensors.items() if value.ndim > 1)
    tensors["model/foreign"] = tensors.pop(missing)
    tensors[wider] = torch.cat([tensors[wider], tensors[wider]])
    write_checkpoint(path, tensors, {"built_as": model.built_as()})
    with pytest.raises(BadInputError, match="weights of another network") as caught:
        model_of("svg", weights=str(path))
    for part in (missing.removeprefix("model/"), "foreign", wider.removeprefix("model/")):
        assert part in str(caught.value)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(DamagedFileError):
        model_of("svg", weights=str(path))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_digest_belongs_to_the_size(name: str) -> None:
    sizes = ("small", "paper", "released")
    built = {size: model_of(name, size=size) for size in sizes}
    assert len({model.digest() for model in built.values()}) == 3
    assert [model.provenance().model for model in built.values()] == [f"{name}-{s}" for s in sizes]


@pytest.mark.parametrize("name", NAMES)
def test_bad_input_is_named(name: str) -> None:
    model = model_of(name)
    context = context_of(model)
    size = model.spec.image_size
    small = with_arrays(context, rgb=context.rgb[:, :, : size // 2, : size // 2])
    with pytest.raises(BadInputError, match=f"{name}-small: pictures must be .* {size}, {size}, 3"):
        model.encode(small)
    with pytest.raises(BadInputError, match=f"{name}-small: pictures must be .* not none"):
        model.encode(with_arrays(context, rgb=None))
    with pytest.raises(BadInputError, match="sizes small, paper, released"):
        model_of(name, size="huge")
    with pytest.raises(BadInputError, match="no weights at"):
        model_of(name, weights="absent.safetensors")


@pytest.mark.parametrize("name", OF_PICTURES)
def test_clips_of_another_size_or_length_or_with_missing_frames_are_refused(name: str) -> None:
    model = model_of(name)
    spec, context = model.spec, context_of(model)
    size, frames = spec.image_size, spec.context
    with pytest.raises(BadInputError, match=rf"pictures must be .*{size}, {size}.*48, 48"):
        model.imagine(squares(2, frames, replace(spec, image_size=48)), 1, 0)
    shorter = context.steps(slice(0, frames - 1))
    with pytest.raises(BadInputError, match=f"from a context of {frames} frames, not {frames - 1}"):
        model.imagine(shorter, 1, 0)
    with pytest.raises(BadInputError, match=f"clips of {model.window} frames, not 2"):
        model.loss(context.steps(slice(0, 2)))
    valid = context.valid.clone()
    valid[1, frames - 1] = False
    with pytest.raises(BadInputError, match=r"squares_0001.*up to frame 44"):
        model.imagine(with_arrays(context, valid=valid), 1, 0)


# Error where something moves, and divergence of Gaussians: closed forms.


def column_clip() -> torch.Tensor:
    """Return a clip (1, 4, 3, 4, 4) of a white column on black, which moves by one a frame."""
    pictures = torch.zeros(1, 4, 3, 4, 4)
    for frame in range(4):
        pictures[0, frame, :, :, frame] = 1
    return pictures


def test_pixels_move_where_a_column_comes_or_goes() -> None:
    moves = moving_pixels(column_clip())
    assert moves.shape == (1, 3, 4, 4)
    for frame in range(3):
        columns = moves[0, frame].all(0).tolist()
        assert columns == [column in (frame, frame + 1) for column in range(4)]


def test_noise_of_compression_does_not_move() -> None:
    pictures = torch.rand(1, 1, 3, 4, 4).repeat(1, 2, 1, 1, 1)
    pictures[:, 1] += 0.9 * CHANGE
    assert not moving_pixels(pictures).any()
    pictures[0, 1, 2, 3, 1] += CHANGE
    assert moving_pixels(pictures).nonzero().tolist() == [[0, 0, 3, 1]]


def test_a_copy_is_wrong_where_the_column_is_and_where_it_was_seen_last() -> None:
    """Frame 2 is copied from frame 1: both columns that move are wrong. Frame 3 as well: of the
    columns 2 and 3, which move, only the third is wrong."""
    pictures, valid = column_clip(), torch.ones(1, 4, dtype=torch.bool)
    error = copy_error(pictures, 2, valid)
    assert error.moving == pytest.approx(3 / 4)
    assert error.pixels == pytest.approx(4 * 4 / 32)


def test_an_empty_scene_is_wrong_where_the_column_is() -> None:
    """The median of two frames has no column; half of the pixels that move show one."""
    pictures, valid = column_clip(), torch.ones(1, 4, dtype=torch.bool)
    error = empty_scene_error(pictures, 2, valid)
    assert error.moving == pytest.approx(1 / 2)
    assert error.pixels == pytest.approx(2 * 4 / 32)


def test_errors_are_means_of_squares_over_what_counts() -> None:
    pictures, valid = column_clip(), torch.ones(1, 4, dtype=torch.bool)
    exact = future_error(pictures[:, 2:], pictures, valid)
    assert exact.moving == exact.pixels == 0
    off = future_error(pictures[:, 2:] + 0.5, pictures, valid)
    assert off.moving == pytest.approx(0.25) and off.pixels == pytest.approx(0.25)
    valid[0, 3] = False
    wrong_at_the_end = pictures[:, 2:].clone()
    wrong_at_the_end[:, 1] += 1
    assert future_error(wrong_at_the_end, pictures, valid).moving == 0
    still = torch.zeros_like(pictures)
    assert future_error(still[:, 2:] + 1, still, valid).moving == 0, "nothing moves"


def test_divergence_of_gaussians_matches_torch() -> None:
    torch.manual_seed(0)
    mean, scale, of_mean, of_scale = torch.randn(4, 5, 7).unbind(0)
    one = Independent(Normal(mean, (scale / 2).exp()), 1)
    other = Independent(Normal(of_mean, (of_scale / 2).exp()), 1)
    divergence = gaussian_divergence(mean, scale, of_mean, of_scale)
    assert torch.allclose(divergence, kl_divergence(one, other), rtol=1e-5)
    assert gaussian_divergence(mean, scale, mean, scale).abs().max() == 0


def test_values_have_the_mean_and_the_variance() -> None:
    noise = torch.randn(100_000, generator=torch.Generator().manual_seed(0))
    values = gaussian_values(torch.tensor(3.0), torch.tensor(4.0).log(), noise)
    assert float(values.mean()) == pytest.approx(3, abs=0.03)
    assert float(values.var()) == pytest.approx(4, rel=0.02)


# --- what is learned in seconds from small pictures ---------------------------------------------


SETTINGS = TrainingSettings(
    batch=8, learning_rate=3e-3, schedule="cosine", warmup=20, clip=1.0, held_out=0.1,
    validate_every=1000, log_every=50,
)  # fmt: skip
TRAINED, TESTED = 400, 100


def svg_of() -> Svg:
    model = Svg(
        SvgSettings(
            image_size=16, code=32, hidden=64, past=3, imagined=3, context=3, future=4,
            weights="random",
        )
    )  # fmt: skip
    model.training_settings = replace(SETTINGS, steps=600)
    return model


def op3_of() -> Op3:
    model = Op3(
        Op3Settings(
            image_size=16, slots=3, width=12, layers=3, hidden=32, effect=16, seed_steps=2, past=3,
            imagined=3, context=3, future=4, weights="random",
        )
    )  # fmt: skip
    model.training_settings = replace(SETTINGS, steps=150)
    return model


def held_out_error(model: Any) -> tuple[float, float, float]:
    """Return errors of moving pixels on trials never seen: of the model, of the copy, and of a
    picture without squares."""
    source = SquaresSource(model.spec, TESTED, seed=99)
    windows = ClipWindows(source, source.trials, model.window)
    (request,) = validation_requests(windows, TESTED, 0)
    batch = windows.read(request).to("cpu")
    pictures = batch.rgb.permute(0, 1, 4, 2, 3).float() / 255
    empty = torch.full_like(pictures[:, -model.settings.imagined :], BACKGROUND / 255)
    without = future_error(empty, pictures, batch.valid).moving
    torch.manual_seed(0)
    with torch.no_grad():
        error = model.eval().loss(batch)["loss"]
        return float(error), float(model.baseline(batch)), float(without)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("build", [svg_of, op3_of], ids=["svg", "op3"])
def test_imagined_squares_are_better_than_a_copy_and_than_none(build: Any) -> None:
    """A model that shows an empty scene is better than the copy too, but predicts no motion."""
    model = build()
    untrained, copy, empty = held_out_error(model)
    source = SquaresSource(model.spec, TRAINED)
    trained = train_model(
        model, source, source.trials, seed=0, name="all", folder=None, accelerator="cpu"
    )
    error, _, _ = held_out_error(model)
    print(f"{model.name}: {error:.4f}, untrained {untrained:.4f}, copy {copy:.4f}, {empty:.4f}")
    assert error < 0.75 * untrained and error < 0.75 * copy and error < 0.9 * empty
    assert trained.validation < trained.baseline


@pytest.mark.nightly
@pytest.mark.slow
def test_boxes_of_falling_squares_are_nearer_than_at_constant_velocity() -> None:
    """The untrained network, whose loss is larger, predicts that nothing moves."""
    model: Any = build_model("rpin", weights="random", image_size=32)

    def clips(count: int, seed: int) -> Batch:
        return squares(count, model.window, model.spec, seed, fall=0.3)

    def errors() -> tuple[float, float]:
        with torch.no_grad():
            own, constant = model.center_errors(clips(40, 10_000))
        return float(own.mean()), float(constant.mean())

    untrained, constant = errors()
    optimizer = torch.optim.Adam(model.parameters(), 2e-3)
    for step in range(60):
        optimizer.zero_grad()
        model.loss(clips(8, step))["loss"].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    own, _ = errors()
    print(f"rpin: {own / constant:.3f} of the error at constant velocity, {own / untrained:.3f}")
    assert own < 0.6 * constant and own < 0.6 * untrained


# Under *full* the features of a model tell the outcome that the later frames show, and nothing if
# these are those of another trial, or if the labels are. Untrained networks do, so that none is
# trained here. For RPIN, whose boxes come from the motions of trials, these are exchanged too.

OPTIONS: dict[str, dict[str, Any]] = {"op3": {"slots": 3}}
"""Options by model; with fewer slots OP3 is quicker."""
COUNTS = {"readout": 24, "testing": 48}
CHANCE = 0.217
"""Three standard errors of the accuracy of guessing 48 trials."""


@dataclass(frozen=True)
class Cases:
    """A dataset, and its copy with exchanged futures."""

    dataset: Dataset
    exchanged: Dataset


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Cases:
    folder = tmp_path_factory.mktemp("dots")
    made = make_dots(folder / "data", COUNTS, ("drop",))
    return Cases(made, with_exchanged_futures(made, folder / "exchanged", motions=False))


@pytest.fixture(scope="module")
def late_motions(tmp_path_factory: pytest.TempPathFactory) -> Cases:
    folder = tmp_path_factory.mktemp("late motions")
    made = make_late_motions(folder / "data", COUNTS)
    return Cases(made, with_exchanged_futures(made, folder / "exchanged", motions=True))


def accuracy_of_full(dataset: Dataset, name: str, folder: Path) -> float:
    settings = EvaluationSettings(
        readouts=("full",), accelerator="cpu", logistic=LogisticSettings(grid=(1e-2, 1.0)),
        untrained=True,
    )  # fmt: skip
    options = {"weights": "random", **OPTIONS.get(name, {})}
    table = evaluate(name, dataset, folder, options=options, settings=settings).predictions
    return float(((table["p_contact"] > 0.5) == table["outcome"]).mean())


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_full_falls_to_chance_with_exchanged_futures(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    made: Cases = request.getfixturevalue("late_motions" if name == "rpin" else "dots")
    own = accuracy_of_full(made.dataset, name, tmp_path / "own")
    fallen = accuracy_of_full(made.exchanged, name, tmp_path / "exchanged")
    # The movies are the same, and so are the features, which need not be made again.
    guessed = accuracy_of_full(with_permuted_labels(made.dataset), name, tmp_path / "own")
    print(f"{name}: {own:.3f}, exchanged futures {fallen:.3f}, permuted labels {guessed:.3f}")
    assert own > 0.5 + CHANCE
    assert abs(fallen - 0.5) < CHANCE and abs(guessed - 0.5) < CHANCE
