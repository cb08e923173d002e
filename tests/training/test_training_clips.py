"""Clips and stored features; observed sources cannot reach a later frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning_fabric import Fabric
from numpy.typing import NDArray

from physion.errors import BadInputError, UnknownNameError
from physion.models import Provenance, Spec, build_model
from physion.training.clips import FeatureStore, FullClips, FutureFrameError, observed_clips
from physion.trials.dataset import Dataset
from physion.trials.video import read_frames
from support.moving_dots import OBSERVED, make_dots

SPEC = Spec(image_size=32)
TINY: dict[str, Any] = {
    "encoder": "test_vit", "image_size": 32, "weights": "random", "hidden": 8,
}  # fmt: skip


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_dots(tmp_path_factory.mktemp("dots"), {"testing": 3}, ("collide",))


@pytest.fixture(scope="module")
def cpu() -> Fabric:
    return Fabric(accelerator="cpu", devices=1)


def test_clips_hold_the_frames_of_the_spec(dots: Dataset) -> None:
    trial = dots.trials()[0]
    observed, full = observed_clips(dots, SPEC).clip(trial), FullClips(dots, SPEC).clip(trial)
    assert observed.frames.shape == (7, 32, 32, 3) and observed.indices == SPEC.observed_indices()
    assert full.frames.shape == (25, 32, 32, 3) and full.indices == SPEC.all_indices()
    movie = read_frames(dots.paths(trial).movie, size=(32, 32))
    assert (full.frames == movie[list(SPEC.all_indices())]).all()
    # Two encodings of one movie: alike, frame by frame, but for the codec's rounding.
    differences = np.abs(observed.frames.astype(int) - full.frames[:7]).mean()
    assert differences < 4 < np.abs(observed.frames.astype(int) - full.frames[18:]).mean()


@pytest.mark.parametrize("frame", [45, 46, 150, 10**6, -1])
def test_no_frame_of_the_future_is_handed_out(dots: Dataset, frame: int) -> None:
    clips = observed_clips(dots, SPEC)
    assert len(clips.read(dots.trials()[0], [0, 22, 44]).frames) == 3
    with pytest.raises(FutureFrameError, match="observed"):
        clips.read(dots.trials()[0], [0, frame])


def test_nothing_inside_the_observed_clips_leads_to_the_future(dots: Dataset) -> None:
    """No object reachable from an observed source refers to the full movies."""
    seen: set[int] = set()

    def walk(thing: object) -> None:
        if id(thing) in seen:
            return
        seen.add(id(thing))
        assert not isinstance(thing, Dataset | FullClips)
        if isinstance(thing, str | Path):
            text = str(thing)
            assert text not in full_names
        elif isinstance(thing, dict):
            for pair in thing.items():
                walk(pair)
        elif isinstance(thing, tuple | list):
            for item in thing:
                walk(item)
        elif type(thing).__module__.startswith("physion") and hasattr(thing, "__dict__"):
            walk(vars(thing))

    full_names = {*dots.index["movie"], *dots.index["movie_sha256"]}
    walk(observed_clips(dots, SPEC))
    assert len(seen) > 5


def test_observed_features_survive_without_the_full_movies(tmp_path: Path, cpu: Fabric) -> None:
    dots = make_dots(tmp_path, {"testing": 1}, ("collide",))
    trial = dots.trials()[0]
    dots.paths(trial).movie.unlink()
    store = FeatureStore(build_model("frozen-encoder", **TINY), None, cpu)
    assert store.features(observed_clips(dots, SPEC), [trial]).shape == (1, 7, 64)
    with pytest.raises(BadInputError, match="missing"):
        store.features(FullClips(dots, SPEC), [trial])


def test_an_observed_movie_that_shows_the_future_is_refused(tmp_path: Path) -> None:
    dots = make_dots(tmp_path, {"testing": 1}, ("collide",))
    paths = dots.paths(dots.trials()[0])
    paths.observed_movie.write_bytes(paths.movie.read_bytes())
    assert len(read_frames(paths.observed_movie)) > OBSERVED
    clip = observed_clips(dots, SPEC).clip(dots.trials()[0])
    assert max(clip.indices) < OBSERVED
    with pytest.raises(BadInputError, match="observed frames"):
        dots.observed_frames(dots.trials()[0])


def test_a_trial_that_ends_early_goes_on_with_its_last_frame(tmp_path: Path) -> None:
    dots = make_dots(tmp_path, {"testing": 1}, ("collide",))
    trial = dots.trials()[0]
    dots.index["frames"] = 100
    clip = FullClips(dots, SPEC).clip(trial)
    assert clip.frames.shape[0] == 25
    assert (clip.frames[17:] == clip.frames[16]).all()
    assert (clip.frames[16] != clip.frames[15]).any()


def test_unknown_trials_get_the_closest_ones(dots: Dataset) -> None:
    for clips in (observed_clips(dots, SPEC), FullClips(dots, SPEC)):
        with pytest.raises(UnknownNameError, match="collide_testing_0000"):
            clips.clip("collide_testing_000")
        with pytest.raises(UnknownNameError):
            clips.key("nothing")


class _Counting:
    """Encoder that counts its clips; the features are mean colours."""

    spec = SPEC

    def __init__(self, digest: str = "a" * 64, fill: float | None = None) -> None:
        self.digest, self.fill, self.seen = digest, fill, 0

    def provenance(self) -> Provenance:
        return Provenance("counting", "none")

    def encoder_digest(self) -> str:
        return self.digest

    def encode(self, frames: torch.Tensor) -> torch.Tensor:
        self.seen += len(frames)
        features = frames.float().mean(dim=(2, 3))
        return features if self.fill is None else torch.full_like(features, self.fill)


def features_of(
    model: Any, folder: Path | None, cpu: Fabric, dots: Dataset, spec: Spec = SPEC
) -> NDArray[np.float32]:
    store = FeatureStore(model, folder, cpu, batch=2)
    return store.features(observed_clips(dots, spec), dots.trials())


def test_features_are_computed_once_for_each_encoder_movie_and_frames(
    dots: Dataset, cpu: Fabric, tmp_path: Path
) -> None:
    first, second = _Counting(), _Counting()
    computed = features_of(first, tmp_path, cpu, dots)
    stored = features_of(second, tmp_path, cpu, dots)
    assert (first.seen, second.seen) == (3, 0)
    assert computed.shape == (3, 7, 3) and (computed == stored).all()
    assert (np.diff(computed, axis=0) != 0).any()
    other = _Counting("b" * 64)
    features_of(other, tmp_path, cpu, dots)
    features_of(other, tmp_path, cpu, dots, replace(SPEC, context=6))
    assert other.seen == 6
    unsaved = _Counting()
    features_of(unsaved, None, cpu, dots)
    assert unsaved.seen == 3


def test_damaged_features_are_computed_again(dots: Dataset, cpu: Fabric, tmp_path: Path) -> None:
    expected = features_of(_Counting(), tmp_path, cpu, dots)
    files = sorted(tmp_path.rglob("*.npy"))
    assert len(files) == 3
    files[0].write_bytes(b"")
    files[1].write_bytes(files[1].read_bytes()[:-5])
    np.save(files[2], np.array([{"evil": 1}], object), allow_pickle=True)
    model = _Counting()
    assert (features_of(model, tmp_path, cpu, dots) == expected).all()
    assert model.seen == 3


def test_mlp_and_lstm_share_their_features(dots: Dataset, cpu: Fabric, tmp_path: Path) -> None:
    for dynamics in ("mlp", "lstm"):
        features_of(build_model("frozen-encoder", **TINY, dynamics=dynamics), tmp_path, cpu, dots)
    assert len(list(tmp_path.rglob("*.npy"))) == 3


def test_features_that_are_not_finite_stop_with_the_trial(dots: Dataset, cpu: Fabric) -> None:
    with pytest.raises(BadInputError, match="collide_testing_0000"):
        features_of(_Counting(fill=float("nan")), None, cpu, dots)


def test_models_that_do_not_see_have_no_features(cpu: Fabric) -> None:
    with pytest.raises(BadInputError, match="noisy-simulation"):
        FeatureStore(build_model("noisy-simulation"), None, cpu)
