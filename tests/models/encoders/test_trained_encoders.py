"""Encoder models with the weights of a training: the model is the one that was trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from physion.core.errors import BadInputError
from physion.models import build_model
from physion.models.checkpoint import WEIGHTS, tensors_of, write_checkpoint
from physion.models.encoders.encoder import EncoderModel
from physion.models.encoders.weights import EncoderWeights, create_encoder
from physion.models.interface import TrainingSettings
from physion.readout.evaluate import evaluate
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings
from physion.training.train import train_model
from support.moving_dots import make_dots
from support.tiny_models import TINY
from support.trained_models import MovingValues

FEW: dict[str, Any] = {**TINY, "image_size": 32, "context": 2, "future": 2}
QUICK = TrainingSettings(steps=3, batch=4, learning_rate=1e-2, held_out=0.25)


def make(**options: Any) -> Any:
    return build_model("frozen-encoder", **{**FEW, **options})


def train(model: Any, folder: Path) -> Path:
    """Train a model in place; return the folder of the training."""
    source = MovingValues(count=8, spec=model.spec)
    result = train_model(
        model, source, source.trials, seed=0, name="all", folder=folder, settings=QUICK,
        features=lambda trials: model.encode(source.whole(trials).to("cpu")).numpy(),
        accelerator="cpu",
    )  # fmt: skip
    assert result.folder is not None
    return result.folder


def features_of(model: EncoderModel) -> tuple[torch.Tensor, torch.Tensor]:
    """Return features of a context, and of what the dynamics imagine to follow it."""
    source = MovingValues(count=2, spec=model.spec)
    context = source.context(source.trials).to("cpu")
    seen = model.encode(context)
    with torch.no_grad():
        later = model.imagine(
            type(context)(context.trials, context.frames, context.valid, features=seen), 1, 0
        )
    return seen, later.features


@pytest.mark.parametrize("fine_tuned", [False, True])
@pytest.mark.parametrize("name", ["", WEIGHTS], ids=["folder", "file"])
def test_weights_of_a_training_give_the_trained_model(
    tmp_path: Path, fine_tuned: bool, name: str
) -> None:
    model = make(fine_tuned=fine_tuned, seed=3)
    untrained = features_of(model)[1]
    folder = train(model, tmp_path)
    # The seed of the random encoder is that of the training.
    loaded = make(fine_tuned=fine_tuned, seed=0, weights=str(folder / name))
    assert loaded.digest() == model.digest() and loaded.encoder_digest() == model.encoder_digest()
    for own, trained in zip(features_of(loaded), features_of(model), strict=True):
        assert torch.equal(own, trained)
    assert not torch.equal(features_of(loaded)[1], untrained)
    assert loaded.trained and not model.trained
    before, after = model.provenance(), loaded.provenance()
    assert after.init.startswith("local:") and before.init == "random"
    assert (after.model, after.encoder_type) == (before.model, before.encoder_type)
    assert after.encoder_pretraining_seed == before.encoder_pretraining_seed == "3"


def test_a_family_keeps_its_name_and_its_encoder_from_a_file(tmp_path: Path) -> None:
    own = tmp_path / "encoder.safetensors"
    encoder = create_encoder("deit_tiny_patch16_224", 32, EncoderWeights("random", 5))
    save_file(encoder.state_dict(), own)
    options = {"image_size": 32, "hidden": 4, "context": 2, "future": 2}
    model: Any = build_model("pDeIT-mlp", weights=str(own), **options)
    folder = train(model, tmp_path / "trainings")
    loaded = build_model("pDeIT-mlp", weights=str(folder), **options)
    assert loaded.provenance().model == model.provenance().model == "pDeIT-mlp-small"
    assert loaded.digest() == model.digest()
    state = encoder.state_dict()
    next(iter(state.values())).view(-1)[0] += 1
    save_file(state, own)
    with pytest.raises(BadInputError, match="another model: encoder was local:"):
        build_model("pDeIT-mlp", weights=str(folder), **options)


def test_weights_of_another_training_are_refused(tmp_path: Path) -> None:
    folder = train(make(), tmp_path)
    with pytest.raises(BadInputError, match=r"settings\.hidden was 16 and is 8"):
        make(hidden=8, weights=str(folder))
    with pytest.raises(BadInputError, match=r"settings\.fine_tuned was False and is True"):
        make(fine_tuned=True, weights=str(folder))
    cswm: Any = build_model("cswm")
    other = tmp_path / "cswm.safetensors"
    write_checkpoint(other, tensors_of(cswm), {"built_as": cswm.built_as()})
    with pytest.raises(BadInputError, match="does not say with which encoder it was trained"):
        make(weights=str(other))
    with pytest.raises(BadInputError, match="weights"):
        make(weights=str(tmp_path / "absent")).encode(MovingValues(1).context(["drop_0000"]))


def test_other_models_take_the_folder_of_a_training_too(tmp_path: Path) -> None:
    model: Any = build_model("cswm", seed=2)
    write_checkpoint(tmp_path / WEIGHTS, tensors_of(model), {"built_as": model.built_as()})
    assert build_model("cswm", weights=str(tmp_path)).digest() == model.digest()
    with pytest.raises(BadInputError, match="no weights at"):
        build_model("cswm", weights=str(tmp_path.parent))


def test_an_evaluation_does_not_train_it_again(tmp_path: Path) -> None:
    counts = {"training": 4, "readout": 8, "testing": 4}
    dots = make_dots(tmp_path / "dots", counts, ("collide",))
    folder = train(make(context=3), tmp_path / "trainings")
    config = EvaluationSettings(accelerator="cpu", logistic=LogisticSettings(grid=(1e-2,)))
    options = {**FEW, "context": 3, "weights": str(folder)}
    table = evaluate(
        "frozen-encoder", dots, tmp_path / "out", options=options, settings=config
    ).predictions
    assert table["init"].str.startswith("local:").all()
    assert np.isfinite(table["p_contact"]).all()
    assert not (tmp_path / "out" / "training").exists()
