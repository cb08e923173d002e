"""Features and imagined futures are the model's, stored once, made again where damaged."""

from __future__ import annotations

import hashlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import nn

from physion import sample_scene
from physion.clips.batch import Batch, Motion, Provenance, Rollout, Spec, cut_to_observed
from physion.compute.local import LocalExecutor, SerialExecutor
from physion.core.errors import BadInputError
from physion.models.build import build_model
from physion.physics.engine import simulate
from physion.readout.features import FeatureStore
from physion.readout.model_calls import OutOfMemoryError
from physion.scenes.scene import Ending

SPEC = Spec(image_size=2, context=3, future=4, context_at="start")
TRIALS = ("roll_1", "roll_2", "drop_1", "drop_2", "link_1")


FUTURE = dict.fromkeys(TRIALS, 4)


def sha(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()


@dataclass
class Movies:
    """Whole source whose pixels follow from the names of trials; it counts what is read."""

    spec: Spec = SPEC
    trials: tuple[str, ...] = TRIALS
    version: int = 0
    lengths: dict[str, int] = field(default_factory=dict)
    read: list[tuple[str, ...]] = field(default_factory=list)

    def _clips(self, trials: Sequence[str], frames: tuple[int, ...]) -> Batch:
        self.read.append(tuple(trials))
        seeds = [[self.version, *trial.encode(), frame] for trial in trials for frame in frames]
        pixels = [np.random.default_rng(seed).integers(0, 255, (2, 2, 3)) for seed in seeds]
        shape = (len(trials), len(frames))
        return Batch(
            tuple(trials),
            frames=np.tile(np.array(frames, np.int64), (len(trials), 1)),
            valid=np.ones(shape, bool),
            rgb=np.array(pixels, np.uint8).reshape(*shape, 2, 2, 3),
        )

    def length(self, trial: str) -> int:
        return self.lengths.get(trial, 50)

    def steps(self, trial: str, part: str) -> int:
        if part == "context":
            return self.spec.context
        return len(self.spec.all_frames(self.length(trial)))

    def context(self, trials: Sequence[str]) -> Batch:
        return self._clips(trials, self.spec.context_frames())

    def whole(self, trials: Sequence[str]) -> Batch:
        return self._clips(trials, self.spec.all_frames(max(map(self.length, trials))))

    def key(self, trial: str, part: str) -> str:
        return sha(self.version, trial, part, self.spec)


class ObservedMovies:
    """The observed part alone of `Movies`."""

    def __init__(self, movies: Movies) -> None:
        self.spec, self.trials = movies.spec, movies.trials
        self.context, self.key, self.steps = movies.context, movies.key, movies.steps


class Network(nn.Module):
    """One linear layer on pixels, and dropout, which evaluation mode switches off."""

    spec = SPEC

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layer, self.dropout = nn.Linear(12, 5), nn.Dropout(0.5)
        self.dynamics = nn.Linear(5, 5)

    def provenance(self) -> Provenance:
        return Provenance("network", "random")

    def digest(self) -> str:
        return sha([(name, value.tolist()) for name, value in self.state_dict().items()])

    def encode(self, batch: Batch) -> Any:
        assert isinstance(batch.rgb, torch.Tensor) and torch.is_inference_mode_enabled()
        return self.dropout(self.layer(batch.rgb.flatten(2).float() / 255))

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        last = self.dynamics(context.features[:, -1]) * arguments.get("scale", 1.0)
        steps = torch.arange(1, SPEC.future + 1)[:, None]
        futures = torch.stack([last[:, None] * steps + sample for sample in range(samples)], 1)
        return Rollout(features=futures, gap=futures.mean((2, 3)).double())


class Numpy:
    """Model without torch; ``give`` makes the features from pixels."""

    spec = SPEC

    def __init__(
        self, give: Callable[[Any], Any] = lambda x: x.reshape(*x.shape[:2], -1) / 2
    ) -> None:
        self.give, self.version = give, 0

    def provenance(self) -> Provenance:
        return Provenance("plain", "none")

    def digest(self) -> str:
        return sha("plain", self.version)

    def encode(self, batch: Batch) -> Any:
        assert isinstance(batch.rgb, np.ndarray)
        return self.give(batch.rgb.astype(np.float32))


def files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("kind", [Network, Numpy])
@pytest.mark.parametrize("part", ["context", "whole"])
def test_features_match_the_model_and_are_computed_once(
    tmp_path: Path, kind: Any, part: Any
) -> None:
    model, movies = kind(), Movies()
    at_once = FeatureStore(tmp_path / "all", batch=2).encoded(model, movies, TRIALS, part)
    frames = {"context": 3, "whole": 7}[part]
    assert at_once.shape == (5, frames, 5 if kind is Network else 12)
    batch = getattr(movies, part)(TRIALS)
    if kind is Network:
        with torch.inference_mode():
            expected = model.layer(torch.tensor(batch.rgb).flatten(2).float() / 255).numpy()
    else:
        expected = model.encode(batch)
    assert at_once.array() == pytest.approx(expected, abs=1e-6)
    store = FeatureStore(tmp_path / "parts", batch=2)
    first = store.encoded(model, movies, TRIALS[:3], part)
    assert len(files(tmp_path / "parts")) == 3
    movies.read.clear()
    again = store.encoded(model, movies, [TRIALS[4], TRIALS[1], TRIALS[4], TRIALS[0]], part)
    assert movies.read == [(TRIALS[4],)], "what is stored is not computed again"
    assert (again.array() == at_once.array()[[4, 1, 4, 0]]).all()
    assert (first.array() == at_once.array()[:3]).all()
    assert again.array().dtype == np.float32


def test_features_after_training_are_never_those_from_before(tmp_path: Path) -> None:
    model, movies, store = Network(), Movies(), FeatureStore(tmp_path)
    before = store.encoded(model, movies, TRIALS, "context").array()
    weights = {name: value.clone() for name, value in model.state_dict().items()}
    loss = model.layer(torch.ones(1, 12)).sum()
    loss.backward()  # type: ignore[no-untyped-call]
    torch.optim.SGD(model.parameters(), lr=0.1).step()
    movies.read.clear()
    after = store.encoded(model, movies, TRIALS, "context").array()
    assert movies.read and not np.isclose(after, before).any()
    fresh = FeatureStore(tmp_path / "fresh").encoded(model, movies, TRIALS, "context").array()
    assert (after == fresh).all()
    model.load_state_dict(weights)
    movies.read.clear()
    assert (store.encoded(model, movies, TRIALS, "context").array() == before).all()
    assert not movies.read, "the features of the first weights are still there"


def test_whole_movies_are_encoded_to_their_own_end_and_repeat_their_last_features(
    tmp_path: Path,
) -> None:
    """Lengths 45, 46, 50, 51 and 100 have 8, 9, 9, 9 and 18 frames: 2, 8, ..., up to the last."""
    lengths = dict(zip(TRIALS, (45, 46, 50, 51, 100), strict=True))
    movies = Movies(Spec(image_size=2), lengths=lengths)
    model: Any = Numpy()
    model.spec = movies.spec
    store = FeatureStore(tmp_path, batch=2)
    found = store.encoded(model, movies, TRIALS, "whole")
    assert movies.read == [TRIALS[:1], TRIALS[1:3], TRIALS[3:4], TRIALS[4:]]
    assert found.shape == (5, 18, 12)
    own = [row[:].reshape(-1, 12) for row in found.by_trial()]
    assert [len(row) for row in own] == [8, 9, 9, 9, 18]
    for trial, row in zip(TRIALS, own, strict=True):
        (expected,) = model.encode(movies.whole([trial]))
        assert (row == expected).all()
    padded = np.stack([row[np.minimum(np.arange(18), len(row) - 1)] for row in own])
    assert (found.array() == padded).all()
    assert (found.columns(90, 130) == padded.reshape(5, -1)[:, 90:130]).all()
    assert (found.frame(17) == padded[:, 17]).all()
    assert (own[4][3:5] == found.by_trial()[4][3:5]).all()
    short = found.select([0, 2])
    assert short.shape == (2, 18, 12), "as wide as what it was chosen from"
    assert (short.array() == padded[[0, 2]]).all()
    assert store.encoded(model, movies, TRIALS[:2], "whole").shape == (2, 9, 12)


def test_long_clips_are_encoded_in_parts_of_equal_numbers(tmp_path: Path) -> None:
    sizes: list[tuple[int, ...]] = []

    def give(pixels: Any) -> Any:
        sizes.append(pixels.shape[:2])
        return flat(pixels)

    lengths = {TRIALS[0]: 602, TRIALS[1]: 602, TRIALS[2]: 150}
    movies = Movies(Spec(image_size=2), lengths=lengths)
    model: Any = Numpy(give)
    model.spec = movies.spec
    found = FeatureStore(tmp_path, batch=4).encoded(model, movies, TRIALS[:3], "whole").array()
    assert sizes == [(1, 13)] * 2 + [(1, 20), (1, 20), (1, 20), (1, 20), (1, 21)] * 2
    assert (found[0] == flat(movies.whole([TRIALS[0]]).rgb)[0]).all()


def test_futures_of_other_lengths_are_stored_apart(tmp_path: Path) -> None:
    model, movies, store = Network(), Movies(), FeatureStore(tmp_path)

    class Steps(Network):
        def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
            return Rollout(features=torch.zeros(len(context), samples, context.future, 1))

    model = Steps()
    options: Any = {"samples": 1, "seed": 0, "arguments": {}}
    for steps in (3, 5, 3):
        future = dict.fromkeys(TRIALS, steps)
        (found,) = store.imagined(model, movies, TRIALS, future=future, **options).values()
        features = found.features()
        assert features is not None and features.shape == (5, steps, 1)
    assert len(files(tmp_path)) == 10
    future = dict(zip(TRIALS, (3, 5, 3, 5, 3), strict=True))
    movies.read.clear()
    store.imagined(model, movies, TRIALS, future=future, **options)
    assert not movies.read, "all were there"


class Forgetful(Numpy):
    """Its digest depends on how often it encoded, as that of a network which is not frozen."""

    def encode(self, batch: Batch) -> Any:
        self.version += 1
        return super().encode(batch)


def test_a_model_that_changes_while_it_encodes_is_refused(tmp_path: Path) -> None:
    model = Forgetful()
    with pytest.raises(BadInputError, match="digest changed while it computed features"):
        FeatureStore(tmp_path).encoded(model, Movies(), TRIALS, "context")
    assert not files(tmp_path)


class Apart(Network):
    """Network whose features do not depend on its dynamics."""

    def encoder_digest(self) -> str:
        return sha(self.layer.weight.tolist(), self.layer.bias.tolist())


def test_dynamics_change_what_is_imagined_and_not_what_is_encoded(tmp_path: Path) -> None:
    model, movies, store = Apart(), Movies(), FeatureStore(tmp_path, batch=2)

    def imagined(**arguments: float) -> tuple[Any, Any]:
        context = store.encoded(model, movies, TRIALS, "context")
        (found,) = store.imagined(
            model, movies, TRIALS[1:], samples=3, seed=0, context=context, future=FUTURE,
            arguments={name: (value,) for name, value in arguments.items()},
        ).values()  # fmt: skip
        return found.features(), found.outcomes()

    features, outcomes = imagined()
    context = FeatureStore(tmp_path / "fresh").encoded(model, movies, TRIALS, "context").array()[1:]
    with torch.inference_mode():
        last = model.dynamics(torch.tensor(context[:, -1])).numpy()
    expected = [last * step + sample for sample in range(3) for step in range(1, 5)]
    assert features.shape == (4, 12, 5), "sample after sample"
    assert features.array() == pytest.approx(np.stack(expected, axis=1), abs=1e-5)
    assert outcomes.gap == pytest.approx(features.array().reshape(4, 3, -1).mean(2), abs=1e-5)
    assert outcomes.contact is None
    movies.read.clear()
    again, stored = imagined()
    assert not movies.read and (again.array() == features.array()).all()
    assert (stored.gap == outcomes.gap).all()
    scaled, _ = imagined(scale=2.0)
    assert not np.isclose(scaled.array(), features.array()).all()
    with torch.no_grad():
        model.dynamics.weight += 1
    movies.read.clear()
    changed, _ = imagined()
    assert movies.read == [TRIALS[1:3], TRIALS[3:]], "only the futures are computed again"
    assert not np.isclose(changed.array(), features.array()).any()


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: b"",
        lambda whole: whole[:5],
        lambda whole: whole[:-1],
        lambda whole: whole + b"\0",
        lambda whole: (2**63).to_bytes(8, "little") + whole[8:],
        lambda whole: (4).to_bytes(8, "little") + b"null" + whole[12:],
        lambda whole: (8).to_bytes(8, "little") + b"[" * 8 + whole[16:],
        lambda whole: (100_000).to_bytes(8, "little") + b"[" * 100_000,
        lambda whole: whole.replace(b'"F32"', b'"F16"'),
    ],
)
def test_a_broken_file_is_written_anew(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    model, movies, store = Numpy(), Movies(), FeatureStore(tmp_path)
    expected = store.encoded(model, movies, TRIALS[:1], "context").array()
    (path,) = files(tmp_path)
    whole = path.read_bytes()
    assert damage(whole) != whole
    path.write_bytes(damage(whole))
    assert (store.encoded(model, movies, TRIALS[:1], "context").array() == expected).all()
    assert path.read_bytes() == whole


def test_a_file_that_is_deleted_while_in_use_is_an_error(tmp_path: Path) -> None:
    features = FeatureStore(tmp_path).encoded(Numpy(), Movies(), TRIALS, "context")
    files(tmp_path)[0].unlink()
    with pytest.raises(BadInputError, match="run again"):
        features.array()


def test_files_are_safetensors(tmp_path: Path) -> None:
    features = FeatureStore(tmp_path).encoded(Numpy(), Movies(), TRIALS[:1], "context").array()
    (path,) = files(tmp_path)
    with safe_open(path, "numpy") as file:
        assert (file.get_tensor("features") == features[0].reshape(-1)).all()


def test_what_was_written_before_a_failure_is_kept(tmp_path: Path) -> None:
    model, movies, store = Numpy(), Movies(), FeatureStore(tmp_path, batch=1)
    good = model.give

    def fail_late(pixels: Any) -> Any:
        if len(movies.read) > 4:
            raise ValueError("too hot")
        return good(pixels)

    model.give = fail_late
    with pytest.raises(BadInputError, match="encode raised ValueError: too hot"):
        store.encoded(model, movies, TRIALS, "context")
    assert len(files(tmp_path)) == 4
    model.give = good
    movies.read.clear()
    store.encoded(model, movies, TRIALS, "context")
    assert movies.read == [(TRIALS[4],)]


def test_features_of_many_trials_keep_no_file_open(tmp_path: Path) -> None:
    descriptors = Path("/proc/self/fd")
    if not descriptors.is_dir():
        pytest.skip("this system does not list open files")
    store = FeatureStore(tmp_path)
    before = len(os.listdir(descriptors))  # noqa: PTH208 - the list itself is what is counted
    features = store.encoded(Numpy(), Movies(), TRIALS, "context")
    features.frame(1)
    assert len(os.listdir(descriptors)) == before  # noqa: PTH208
    assert len(features) == 5


def with_nan(pixels: Any) -> Any:
    features = pixels.reshape(*pixels.shape[:2], -1).copy()
    features[-1, 2, 7] = np.nan
    return features


def test_features_that_are_not_finite_name_model_trial_and_tensor(tmp_path: Path) -> None:
    store = FeatureStore(tmp_path, batch=2)
    with pytest.raises(BadInputError) as caught:
        store.encoded(Numpy(with_nan), Movies(), TRIALS, "context")
    assert str(caught.value).startswith(
        "model 'plain', trial 'roll_2': encode gave features that are not finite (nan at (2, 7)"
    )
    assert not files(tmp_path)


def flat(pixels: Any) -> Any:
    return pixels.reshape(*pixels.shape[:2], -1)


@pytest.mark.parametrize(
    ("give", "got"),
    [
        (lambda x: flat(x).astype(np.float64), "float64 (2, 3, 12)"),
        (lambda x: flat(x)[:1], "float32 (1, 3, 12)"),
        (lambda x: flat(x)[:, :2], "float32 (2, 2, 12)"),
        (lambda x: flat(x)[..., :0], "float32 (2, 3, 0)"),
        (lambda x: x, "float32 (2, 3, 2, 2, 3)"),
        (lambda x: flat(x).tolist(), "list"),
        (lambda x: None, "NoneType"),
    ],
)
def test_features_of_another_shape_or_type_are_refused(tmp_path: Path, give: Any, got: str) -> None:
    with pytest.raises(BadInputError) as caught:
        FeatureStore(tmp_path, batch=2).encoded(Numpy(give), Movies(), TRIALS, "context")
    assert str(caught.value) == (
        f"model 'plain': encode gave features as {got}, expected float32 (2, 3, any)"
    )


def test_features_of_unequal_trials_are_refused(tmp_path: Path) -> None:
    sizes = iter([12, 12, 6])
    model = Numpy(lambda x: flat(x)[..., : next(sizes)])
    with pytest.raises(BadInputError, match=r"'link_1' have shape .*6.*but 'roll_1' has .*12"):
        FeatureStore(tmp_path, batch=2).encoded(model, Movies(), TRIALS, "context")


def test_fewer_steps_are_for_models_that_combine_frames(tmp_path: Path) -> None:
    model = Numpy(lambda x: flat(x).mean(axis=1, keepdims=True))
    model.spec = Spec(image_size=2, context=3, future=4, framewise=False)
    assert FeatureStore(tmp_path).encoded(model, Movies(), TRIALS, "context").shape == (5, 1, 12)
    model.give = lambda x: np.concatenate([flat(x)] * 2, axis=1)
    with pytest.raises(BadInputError, match="6 time steps for clips of 3 frames"):
        FeatureStore(tmp_path / "more").encoded(model, Movies(), TRIALS, "context")


class Dreamer(Numpy):
    """Model that imagines what it is given."""

    def __init__(self, **given: Any) -> None:
        super().__init__()
        self.given = given

    def imagine(self, context: Batch, samples: int, seed: int) -> Any:
        return self.given.get("rollout") or Rollout(**self.given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"features": np.zeros((5, 2, 3, 1), np.float32)}, "expected float32 (5, 2, 4, any)"),
        ({"features": np.full((5, 2, 4, 1), np.inf, np.float32)}, "trial 'roll_1': imagine gave"),
        ({"gap": np.zeros((5, 3))}, "gap as float64 (5, 3), expected float64 (5, 2)"),
        ({"gap": np.full((5, 2), np.nan)}, "imagine gave gap that are not finite"),
        ({"contact": np.zeros((5, 2))}, "contact as float64 (5, 2), expected bool (5, 2)"),
        ({}, "imagine gave none of features, gap and contact"),
        ({"rollout": 3}, "imagine gave int, expected Rollout"),
    ],
)
def test_wrong_rollouts_are_refused(tmp_path: Path, given: Any, message: str) -> None:
    with pytest.raises(BadInputError) as caught:
        FeatureStore(tmp_path, batch=5).imagined(
            Dreamer(**given), Movies(), TRIALS, samples=2, seed=0, arguments={}, future=FUTURE
        )
    assert message in str(caught.value)


def test_only_outcomes_are_stored_too(tmp_path: Path) -> None:
    contact = np.array([[True, False]] * 5)
    options: Any = {"samples": 2, "arguments": {}, "future": FUTURE}
    model, movies, store = Dreamer(contact=contact), Movies(), FeatureStore(tmp_path, batch=5)
    for _ in range(2):
        found = store.imagined(model, movies, TRIALS, seed=0, **options)[()]
        outcomes = found.outcomes()
        assert found.features() is None and outcomes.gap is None
        assert outcomes.contact.dtype == bool and (outcomes.contact == contact).all()
    assert len(movies.read) == 1
    store.imagined(model, movies, TRIALS, seed=1, **options)
    assert len(movies.read) == 2


def exhausted(what: str, tmp_path: Path, batch: int) -> None:
    """Use up memory: numpy's or torch's, a device's, while reading, or while imagining."""

    def encode(batch: Batch) -> Any:
        if what == "device":
            raise torch.OutOfMemoryError("CUDA: tried to get 20.00 MiB")
        return torch.ones(2**50) if what == "torch" else np.ones(2**50)

    def context(trials: Sequence[str]) -> Batch:
        raise MemoryError

    model: Any = Network() if what in ("torch", "device") else Dreamer()
    movies: Any = Movies()
    store = FeatureStore(tmp_path, batch=batch)
    if what == "reading":
        movies.context = context
    if what == "imagining":
        model.imagine = lambda context, samples, seed: np.ones(2**50)
        store.imagined(model, movies, TRIALS, samples=2, seed=0, arguments={}, future=FUTURE)
    else:
        model.encode = encode
        store.encoded(model, movies, TRIALS, "context")


@pytest.mark.parametrize("what", ["numpy", "torch", "device", "reading", "imagining"])
def test_memory_used_up_names_the_setting_to_lower(what: str, tmp_path: Path) -> None:
    with pytest.raises(OutOfMemoryError, match=r"3 clips .*lower the option encoder_batch, now 3"):
        exhausted(what, tmp_path, 3)
    advice = "use a smaller image_size or size of the model, or fewer"
    with pytest.raises(OutOfMemoryError, match=advice):
        exhausted(what, tmp_path, 1)


def test_what_a_model_raises_names_model_method_and_line(tmp_path: Path) -> None:
    def divide(pixels: Any) -> Any:
        return 1 // 0

    with pytest.raises(BadInputError) as caught:
        FeatureStore(tmp_path).encoded(Numpy(divide), Movies(), TRIALS, "context")
    line = divide.__code__.co_firstlineno + 1
    assert "model 'plain': encode raised ZeroDivisionError" in str(caught.value)
    assert f"({Path(__file__).name}, line {line})" in str(caught.value)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    absent: Any = Network()
    absent.encode = None
    with pytest.raises(BadInputError, match="has no method encode"):
        FeatureStore(tmp_path).encoded(absent, Movies(), TRIALS, "context")


def test_every_part_of_a_network_is_in_its_mode_again(tmp_path: Path) -> None:
    model = Network()
    model.train()
    model.dropout.eval()
    FeatureStore(tmp_path).encoded(model, Movies(), TRIALS, "context")
    assert model.training and model.layer.training and not model.dropout.training
    assert torch.is_grad_enabled() and not torch.is_inference_mode_enabled()


def test_later_frames_need_a_whole_source(tmp_path: Path) -> None:
    observed: Any = ObservedMovies(Movies())
    store = FeatureStore(tmp_path)
    assert store.encoded(Numpy(), observed, TRIALS, "context").shape == (5, 3, 12)
    with pytest.raises(BadInputError, match="no part 'whole'"):
        store.encoded(Numpy(), observed, TRIALS, "whole")


def test_bad_folders_batches_and_digests_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="at least 1, not 0"):
        FeatureStore(tmp_path, batch=0)
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(BadInputError, match="cannot be stored in"):
        FeatureStore(tmp_path / "file").encoded(Numpy(), Movies(), TRIALS, "context")
    model: Any = Numpy()
    model.digest = lambda: "../" * 10
    with pytest.raises(BadInputError, match="expected a SHA-256"):
        FeatureStore(tmp_path).encoded(model, Movies(), TRIALS, "context")


def test_progress_counts_what_is_computed(tmp_path: Path) -> None:
    calls: list[tuple[str, int, int]] = []
    store = FeatureStore(tmp_path, batch=2)
    for _ in range(2):
        store.encoded(Numpy(), Movies(), TRIALS, "context", lambda *call: calls.append(call))
    assert calls == [("features", done, 3) for done in range(4)], "nothing of what is stored"


def test_no_trial_has_no_feature(tmp_path: Path) -> None:
    store = FeatureStore(tmp_path)
    assert store.encoded(Numpy(), Movies(), [], "context").array().size == 0
    found = store.imagined(Dreamer(), Movies(), [], samples=1, seed=0, arguments={}, future={})[()]
    assert found.trials == () and len(found.outcomes().touches()) == 0


def test_models_without_torch_do_not_import_it() -> None:
    code = (
        "import sys, physion.readout.features, physion.readout.logistic\n"
        "print(*{'torch', 'lightning_fabric', 'timm'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


class Source:
    """Source of some motions; trials named ``bad...`` cannot be read."""

    def __init__(self, trials: Sequence[str], motions: Sequence[Motion] = ()) -> None:
        self.motions = dict(zip(trials, motions, strict=False))

    def key(self, trial: str, part: str) -> str:
        return f"{trial} {part}"

    def context(self, trials: Sequence[str]) -> Batch:
        for trial in trials:
            if trial.startswith("bad"):
                raise BadInputError(f"{trial} is damaged")
        frames = np.arange(2, 45, 3)[None].repeat(len(trials), 0)
        state = tuple(self.motions[trial] for trial in trials) if self.motions else None
        return Batch(tuple(trials), frames, np.ones_like(frames, np.bool_), state=state)


class Counts:
    """Model that gives the length of a name as its gap, and fails for ``odd...``."""

    spec = Spec(inputs=("state",), future=0)

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def digest(self) -> str:
        return "0" * 64

    def provenance(self) -> Any:
        return SimpleNamespace(model="counts")

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        self.sizes.append(len(context))
        if any(trial.startswith("odd") for trial in context.trials):
            raise BadInputError("an odd trial")
        gaps = np.array([[float(len(trial))] * samples for trial in context.trials])
        return Rollout(gap=gaps * arguments.get("factor", 1.0))


def test_trials_that_fail_cost_no_other_trial(tmp_path: Path) -> None:
    names = ["a", "bb", "bad", "ccc", "odd", "dddd"]
    store, model = FeatureStore(tmp_path), Counts()
    source: Any = Source(names)
    found = store.imagined(
        model, source, names, samples=1, seed=0, arguments={"factor": (1.0, 2.0)}, together=3,
        future=dict.fromkeys(names, 0),
    )  # fmt: skip
    for factor in (1, 2):
        imagined = found[(("factor", float(factor)),)]
        assert imagined.trials == ("a", "bb", "ccc", "dddd")
        assert imagined.outcomes().gap.tolist() == [[factor * n] for n in (1, 2, 3, 4)]  # type: ignore[union-attr]
    assert store.problems == {"bad": "bad is damaged", "odd": "an odd trial"}
    assert max(model.sizes) == 3 and 1 in model.sizes


@pytest.mark.parametrize(("name", "weights"), [("gns-ransac", "random"), ("dpi", "shipped")])
def test_a_pickled_particle_model_is_the_same(name: str, weights: str) -> None:
    model: Any = build_model(name, weights=weights, seed=3, samples=2)
    again = pickle.loads(pickle.dumps(model))
    assert again.digest() == model.digest() and again.provenance() == model.provenance()
    assert (again.trained, again.samples, again.decision) == (
        model.trained, model.samples, model.decision,
    )  # fmt: skip


@pytest.mark.nightly
@pytest.mark.slow
def test_particle_models_imagine_the_same_in_processes(tmp_path: Path) -> None:
    motions = []
    for seed in range(3):
        scene = replace(sample_scene("collide", seed), ending=Ending(60, 60))
        motions.append(Motion(scene, cut_to_observed(scene, simulate(scene))))
    names = [f"trial_{row}" for row in range(3)]
    source: Any = Source(names, motions)
    model: Any = build_model("dpi")
    assert model.trials_together > 1
    options: Any = {"samples": 1, "seed": 0, "arguments": {}, "together": 2}
    options["future"] = dict.fromkeys(names, 0)
    found = [
        FeatureStore(tmp_path / type(executor).__name__, executor=executor).imagined(
            model, source, names, **options
        )[()]
        for executor in (SerialExecutor(), LocalExecutor(2))
    ]
    assert found[0].trials == tuple(names)
    assert found[0].outcomes().gap == pytest.approx(found[1].outcomes().gap, abs=1e-6)
