"""Encoders of transformers by name: small networks, in folders as the library writes them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from physion.core.errors import BadInputError
from physion.models import Batch
from physion.models.build import build_model
from support.programs import absent

try:
    import transformers
except ModuleNotFoundError:
    absent("transformers is not installed: it comes with the extra video")

SIZE, PATCH, WIDTH = 32, 8, 24
MEAN, STD = [0.1, 0.2, 0.3], [0.5, 0.6, 0.7]
SMALL: dict[str, Any] = {
    "image_size": SIZE, "patch_size": PATCH, "hidden_size": WIDTH, "num_hidden_layers": 3,
    "num_attention_heads": 2, "intermediate_size": 48,
}  # fmt: skip


def network(kind: str) -> Any:
    """A small network with random weights, as it would be published."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        if kind == "dinov3":
            config = transformers.DINOv3ViTConfig(**SMALL, num_register_tokens=2)
            return transformers.DINOv3ViTModel(config)
        if kind == "videomae":
            return transformers.VideoMAEForVideoClassification(
                transformers.VideoMAEConfig(**SMALL, num_frames=16, use_mean_pooling=False)
            )
        config = transformers.VJEPA2Config(
            crop_size=SIZE, patch_size=PATCH, frames_per_clip=64, hidden_size=WIDTH,
            num_hidden_layers=3, num_attention_heads=2, pred_num_hidden_layers=1,
            pred_hidden_size=WIDTH, pred_num_attention_heads=2,
        )  # fmt: skip
        return transformers.VJEPA2Model(config)


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folders = {}
    for kind in ("dinov3", "videomae", "vjepa2"):
        folder = folders[kind] = tmp_path_factory.mktemp("hub") / f"{kind}-tiny"
        network(kind).save_pretrained(folder)
        size = {"height": SIZE, "width": SIZE}
        processor = {"image_mean": MEAN, "image_std": STD, "crop_size": size}
        name = f"{'video_' * (kind == 'vjepa2')}preprocessor_config.json"
        (folder / name).write_text(json.dumps(processor))
    return folders


def clips(frames: int) -> Batch:
    random = np.random.default_rng(0)
    rgb = random.integers(0, 256, (2, frames, SIZE, SIZE, 3), np.uint8)
    shape = rgb.shape[:2]
    return Batch(("a", "b"), np.zeros(shape, np.int64), np.ones(shape, np.bool_), rgb=rgb).to("cpu")


def given(batch: Batch) -> Tensor:
    pictures = batch.rgb.float() / 255
    return ((pictures - torch.tensor(MEAN)) / torch.tensor(STD)).permute(0, 1, 4, 2, 3)


def test_an_image_encoder_gives_what_its_own_library_computes(published: dict[str, Path]) -> None:
    name = f"hf:{published['dinov3']}"
    model: Any = build_model(name)
    assert model.spec.context_frames() == tuple(range(2, 45, 6)) and model.spec.framewise
    assert (model.spec.image_size, model.spec.mean) == (SIZE, tuple(MEAN))
    batch = clips(3)
    alone = transformers.DINOv3ViTModel.from_pretrained(published["dinov3"]).eval()
    with torch.no_grad():
        output = alone(given(batch).flatten(0, 1), output_hidden_states=True)
    tokens = output.last_hidden_state.view(2, 3, 3 + 16, WIDTH)
    close = {"rtol": 1e-4, "atol": 1e-5}
    torch.testing.assert_close(model.encode(batch), tokens[:, :, 0], **close)
    mean = build_model(name, pooling="mean")
    torch.testing.assert_close(mean.encode(batch), tokens[:, :, 3:].mean(2), **close)
    grid: Any = build_model(name, pooling="grid")
    torch.testing.assert_close(grid.encode(batch), tokens[:, :, 3:].flatten(2), **close)
    attentive: Any = build_model(name, pooling="attentive")
    assert torch.equal(attentive.encode(batch), grid.encode(batch))
    assert (attentive.tokens, attentive.decision) == (grid.tokens, "attentive") == (16, "attentive")
    second = output.hidden_states[2].view(2, 3, 19, WIDTH)
    layer: Any = build_model(name, layer=2, pooling="mean")
    torch.testing.assert_close(layer.encode(batch), second[:, :, 3:].mean(2), **close)
    assert layer.name() == "dinov3-tiny-mean-layer2" and layer.init.startswith("local:")
    assert len({m.digest() for m in (model, mean, grid, layer)}) == 4


@pytest.mark.parametrize("kind", ["videomae", "vjepa2"])
def test_clips_of_a_video_encoder_end_with_the_last_observed_frame(
    kind: str, published: dict[str, Path]
) -> None:
    model: Any = build_model(f"hf:{published[kind]}")
    assert model.spec.context_frames() == tuple(range(14, 45, 2)) and not model.spec.framewise
    batch = clips(16)
    alone: Any = network(kind)
    alone = (alone.videomae if kind == "videomae" else alone.encoder).eval()
    with torch.no_grad():
        tokens = alone(given(batch)).last_hidden_state.view(2, 8, 16, WIDTH)
    torch.testing.assert_close(model.encode(batch), tokens.mean(2), rtol=1e-4, atol=1e-5)
    longer = clips(19)
    repeated = longer.steps(slice(0, 16))
    torch.testing.assert_close(model.encode(longer)[:, :8], model.encode(repeated))
    assert model.encode(longer).shape == (2, 16, WIDTH)


@pytest.mark.parametrize("kind", ["videomae", "vjepa2"])
def test_registered_names_and_hf_agree(kind: str, published: dict[str, Path]) -> None:
    """On one file of weights and equal statistics; hf: reads the sizes, the others are given."""
    hub: Any = build_model(f"hf:{published[kind]}", pooling="grid")
    name = {"videomae": "VideoMAE", "vjepa2": "V-JEPA2"}[kind]
    own: Any = build_model(
        name, weights=str(published[kind] / "model.safetensors"), image_size=SIZE, patch=PATCH,
        width=WIDTH, depth=3, heads=2, mlp=2.0 if kind == "videomae" else 4.0, pooling="grid",
    )  # fmt: skip
    own.spec = replace(own.spec, mean=hub.spec.mean, std=hub.spec.std)
    assert own.spec == hub.spec and own.init == hub.init
    batch = clips(19)
    torch.testing.assert_close(own.encode(batch), hub.encode(batch), rtol=1e-4, atol=1e-5)


def test_random_weights_follow_the_seed(published: dict[str, Path]) -> None:
    name = f"hf:{published['dinov3']}"
    torch.manual_seed(1)
    one: Any = build_model(name, weights="random")
    torch.manual_seed(2)
    assert build_model(name, weights="random").digest() == one.digest()
    assert build_model(name, weights="random", seed=1).digest() != one.digest()
    assert one.name() == "random-dinov3-tiny" and one.provenance().init == "random"


def test_what_cannot_be_loaded_is_one_line(published: dict[str, Path], tmp_path: Path) -> None:
    for name, options, message in (
        (f"hf:{published['dinov3']}", {"layer": 4}, "has the layers 1 to 3, not 4"),
        (f"hf:{published['dinov3']}", {"weights": "a.pt"}, "published or random"),
        (f"hf:{tmp_path}", {}, "could not be loaded"),
        ("hf:", {}, "is called hf:NAME"),
    ):
        with pytest.raises(BadInputError, match=message) as caught:
            build_model(name, **options)
        assert "\n" not in str(caught.value)


def saved(
    folder: Path, kind: str, *, processor: dict[str, Any] | None = None, **config: Any
) -> str:
    """Write a network with random weights, and return its name."""
    own = getattr(transformers, f"{kind}Model")
    own(own.config_class(**config)).save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(processor or {}))
    return f"hf:{folder}"


def test_an_encoder_that_leaves_out_patches_at_random_is_refused(tmp_path: Path) -> None:
    for ratio in (0.75, 0.0):
        name = saved(tmp_path / str(ratio), "ViTMAE", **SMALL, mask_ratio=ratio)
        with pytest.raises(BadInputError, match=r"patches at random.*timm:vit_base_patch16_224"):
            build_model(name)


@pytest.mark.parametrize("depths", [[1, 1, 5, 1], [1, 1, 1, 1]])
def test_stages_are_no_layers(tmp_path: Path, depths: list[int]) -> None:
    widths = [8, 16, 24, 32]
    name = saved(tmp_path / "net", "ConvNext", depths=depths, hidden_sizes=widths, image_size=SIZE)
    with pytest.raises(BadInputError, match="divided into stages; leave out layer"):
        build_model(name, layer=1)
    assert build_model(name, image_size=SIZE).encode(clips(2)).shape == (2, 2, 32)


def test_sizes_of_patches_may_be_tuples(tmp_path: Path) -> None:
    video = {n: value for n, value in SMALL.items() if n != "patch_size"}
    name = saved(tmp_path / "vivit", "Vivit", **video, num_frames=16, tubelet_size=[4, 8, 8])
    model: Any = build_model(name, image_size=SIZE)
    assert (model.tubelet, model.patch) == (4, 8)
    assert model.encode(clips(16)).shape == (2, 1, WIDTH), "a class token stands before the others"
    square = SMALL | {"patch_size": [PATCH, PATCH]}
    image: Any = build_model(saved(tmp_path / "dinov2", "Dinov2", **square), pooling="grid")
    assert image.encode(clips(2)).shape == (2, 2, 16 * WIDTH)


@pytest.mark.parametrize(
    ("processor", "mean", "std"),
    [
        ({"do_normalize": False, "image_mean": MEAN, "image_std": STD}, (0, 0, 0), (1, 1, 1)),
        ({"image_mean": 0.5, "image_std": 0.25}, (0.5, 0.5, 0.5), (0.25, 0.25, 0.25)),
        ({"image_mean": MEAN, "image_std": STD, "rescale_factor": 0.00392156862745098}, MEAN, STD),
    ],
)
def test_pictures_are_normalised_as_published(
    tmp_path: Path, processor: dict[str, Any], mean: Any, std: Any
) -> None:
    name = saved(tmp_path / "net", "Dinov2", processor=processor, **SMALL)
    model, batch = build_model(name), clips(2)
    pictures = (batch.rgb.float() / 255 - torch.tensor(mean)) / torch.tensor(std)
    alone = transformers.Dinov2Model.from_pretrained(tmp_path / "net").eval()
    with torch.no_grad():
        tokens = alone(pictures.flatten(0, 1).permute(0, 3, 1, 2)).last_hidden_state
    expected = tokens[:, 0].view(2, 2, WIDTH)
    torch.testing.assert_close(model.encode(batch), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("processor", "what"),
    [
        ({"rescale_factor": 1 / 127.5}, "rescale_factor 0.0078"),
        ({"do_rescale": False}, "rescale_factor 1,"),
        ({"rescale_offset": True}, "rescale_offset True"),
        ({"offset": True}, "offset True"),
        ({"do_flip_channel_order": True}, "do_flip_channel_order True"),
    ],
)
def test_other_preprocessing_is_refused(
    tmp_path: Path, processor: dict[str, Any], what: str
) -> None:
    name = saved(tmp_path / "net", "Dinov2", processor=processor, **SMALL)
    with pytest.raises(BadInputError, match=f"needs pictures with {what}"):
        build_model(name)


@pytest.mark.parametrize(
    ("kind", "frames", "message"),
    [
        ("dinov3", 8, "is a network of images; leave out frames"),
        ("vjepa2", 46, "must be 1 to 45, which are observed, not 46"),
        ("vjepa2", 0, "must be 1 to 45, which are observed, not 0"),
        ("vjepa2", 7, "joins 2 frames; choose frames that are a multiple of it, not 7"),
        ("videomae", 8, "takes no clips of 8 frames with 32 pixels per side; choose frames"),
    ],
)
def test_frames_that_a_network_does_not_take_are_one_line(
    published: dict[str, Path], kind: str, frames: int, message: str
) -> None:
    with pytest.raises(BadInputError, match=message) as caught:
        build_model(f"hf:{published[kind]}", frames=frames)
    assert "\n" not in str(caught.value)


def test_weights_that_lack_a_tensor_and_code_of_others_are_refused(
    published: dict[str, Path], tmp_path: Path
) -> None:
    """The library would draw the tensor at random, and ask whether to run the code."""
    folder = tmp_path / "cut"
    network("dinov3").save_pretrained(folder)
    state = load_file(folder / "model.safetensors")
    gone = next(name for name in state if "layer.1" in name and name.endswith("weight"))
    save_file({n: v for n, v in state.items() if n != gone}, folder / "model.safetensors")
    with pytest.raises(BadInputError, match=r"lack .*layer\.1"):
        build_model(f"hf:{folder}")
    config = json.loads((folder / "config.json").read_text())
    config |= {"model_type": "own", "auto_map": {"AutoConfig": "own.Config", "AutoModel": "own.M"}}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "own.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w').write('x')")
    with pytest.raises(BadInputError, match="could not be loaded"):
        build_model(f"hf:{folder}")
    assert not (tmp_path / "ran").exists()
