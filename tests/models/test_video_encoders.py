"""Video encoders: clips that end with the last observed frame, weights by name or from a file."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import huggingface_hub
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from physion.core.errors import BadInputError
from physion.models import Batch
from physion.models.build import build_model
from support.programs import absent
from support.tiny_models import VIDEO

try:
    import transformers
except ModuleNotFoundError:
    absent("transformers is not installed: it comes with the extra video")

from physion.models.encoders import video as video_networks
from physion.models.encoders.video import VideoEncoder

NAMES = ["VideoMAE", "V-JEPA2", "VideoMAEv2", "V-JEPA2.1"]


def make(name: str, **options: Any) -> VideoEncoder:
    model = build_model(name, **{**VIDEO, **options})
    assert isinstance(model, VideoEncoder)
    return model


def pictures(frames: int, size: int = 32, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (2, frames, size, size, 3), dtype=torch.uint8, generator=generator)


def batch(rgb: Tensor) -> Batch:
    shape = rgb.shape[:2]
    return Batch(
        ("a", "b"), np.zeros(shape, np.int64), np.ones(shape, np.bool_), rgb=rgb.numpy()
    ).to("cpu")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", ["small", "paper"])
def test_the_context_ends_with_the_last_observed_frame(
    name: str, size: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "physion.models.encoders.video.create_video_encoder",
        lambda family, config: (torch.nn.Identity(), config.weights),
    )
    model = build_model(name, size=size)
    spec = model.spec
    assert spec.context_frames() == tuple(range(14, 45, 2)) and not spec.framewise
    assert spec.all_frames(151)[16:] == tuple(range(46, 151, 2))
    provenance = model.provenance()
    named = provenance.init.startswith("hub:")
    assert provenance.model == f"{'' if named else 'random-'}{name}-{size}"
    assert bool(provenance.encoder_pretraining_dataset) is named


@pytest.mark.parametrize("name", NAMES)
def test_features_of_a_clip_depend_on_all_its_frames_and_on_no_other_clip(name: str) -> None:
    model = make(name)
    rgb = pictures(12)
    features = model.encode(batch(rgb))
    assert features.shape == (2, 6, 24) and features.dtype == torch.float32
    assert torch.equal(model.encode(batch(rgb[:, :4])), features[:, :2])
    changed = rgb.clone()
    changed[:, 4:] = pictures(8, seed=1)
    assert torch.equal(model.encode(batch(changed))[:, :2], features[:, :2])
    changed = rgb.clone()
    changed[:, 3] = pictures(1, seed=1)[:, 0]
    change = (model.encode(batch(changed)) - features).abs().amax((0, 2))
    assert (change[:2] > 1e-6).all() and (change[2:] == 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_last_clip_repeats_the_last_frame(name: str) -> None:
    model = make(name)
    rgb = pictures(8)
    for missing in (1, 2, 3):
        known = rgb[:, : 8 - missing]
        filled = torch.cat([known, known[:, -1:].expand(-1, missing, -1, -1, -1)], 1)
        assert torch.equal(model.encode(batch(known)), model.encode(batch(filled)))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_tokens_are_averaged_at_one_time_and_in_cells(name: str) -> None:
    model, grid = make(name), make(name, pooling="grid", image_size=64)
    small = batch(pictures(4))
    tokens = model.network(model_input(model, small)).last_hidden_state
    expected = tokens.view(2, 2, 16, 24).mean(2)
    assert torch.allclose(model.encode(small), expected, atol=1e-6)
    large = batch(pictures(4, 64))
    tokens = grid.network(model_input(grid, large)).last_hidden_state
    cells = tokens.view(2, 2, 4, 2, 4, 2, 24).mean((3, 5)).reshape(2, 2, -1)
    assert torch.allclose(grid.encode(large), cells, atol=1e-6)
    assert grid.name() == f"random-{name}-grid-small" and (grid.tokens, model.tokens) == (16, 1)
    attentive = make(name, pooling="attentive", image_size=64)
    assert torch.equal(attentive.encode(large), grid.encode(large))
    assert (attentive.tokens, attentive.decision) == (16, "attentive")


def model_input(model: VideoEncoder, clips: Batch) -> Tensor:
    mean, std = (torch.tensor(v).view(3, 1, 1) for v in (model.spec.mean, model.spec.std))
    return (clips.rgb.permute(0, 1, 4, 2, 3).float() / 255 - mean) / std


@pytest.mark.parametrize("name", NAMES)
def test_random_weights_follow_the_seed_and_nothing_is_trained(name: str) -> None:
    torch.manual_seed(1)
    one = make(name)
    torch.manual_seed(2)
    assert make(name).digest() == one.digest() != make(name, seed=1).digest()
    assert make(name, pooling="grid").digest() != one.digest() != make(name, stride=3).digest()
    assert not any(p.requires_grad for p in one.parameters()) and not one.network.training


def files(folder: Path) -> dict[str, Path]:
    """Checkpoints as the networks that were trained are published, with all their parts."""
    tiny: dict[str, Any] = {
        "image_size": 32, "patch_size": 8, "num_frames": 4, "hidden_size": 24,
        "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 96,
        "decoder_hidden_size": 24, "decoder_num_hidden_layers": 1,
        "decoder_num_attention_heads": 2, "decoder_intermediate_size": 24,
    }  # fmt: skip
    mae = transformers.VideoMAEForPreTraining(
        transformers.VideoMAEConfig(**tiny, use_mean_pooling=False)
    )
    jepa = transformers.VJEPA2ForVideoClassification(
        transformers.VJEPA2Config(
            crop_size=32, patch_size=8, frames_per_clip=4, hidden_size=24, num_hidden_layers=2,
            num_attention_heads=2, pred_num_hidden_layers=1, num_pooler_layers=1,
        )
    )  # fmt: skip
    old = {"attention.query.bias": "attention.q_bias", "attention.value.bias": "attention.v_bias"}
    state = {}
    for name, value in mae.state_dict().items():
        for new, before in old.items():
            name = name.replace(new, before)
        state[name] = value
    assert any(name.endswith("q_bias") for name in state)
    paths = {"VideoMAE": folder / "mae.safetensors", "V-JEPA2": folder / "jepa.safetensors"}
    save_file(state, paths["VideoMAE"])
    save_file(jepa.state_dict(), paths["V-JEPA2"])
    return paths


@pytest.mark.parametrize("name", NAMES[:2])
def test_published_checkpoints_are_read_with_all_tensors(name: str, tmp_path: Path) -> None:
    path = files(tmp_path)[name]
    model = make(name, weights=str(path))
    assert model.provenance().model == f"{name}-small"
    assert model.provenance().init.startswith("local:")
    assert model.digest() != make(name).digest()
    stored = {
        tuple(v.flatten()[:3].tolist()) for v in video_networks.read_state_dict(path).values()
    }
    for value in model.network.state_dict().values():
        assert tuple(value.flatten()[:3].tolist()) in stored


@pytest.mark.parametrize("name", NAMES[:2])
def test_weights_of_another_network_name_the_tensors_that_differ(name: str, tmp_path: Path) -> None:
    paths = files(tmp_path)
    other = paths[NAMES[1 - NAMES.index(name)]]
    with pytest.raises(BadInputError, match=rf"'{name}': \S+ is missing; .*and \d+ more") as caught:
        make(name, weights=str(other))
    assert "\n" not in str(caught.value)
    with pytest.raises(BadInputError, match=r"embeddings\.patch\S+ is \(24, .* in the model"):
        make(name, weights=str(paths[name]), width=48)
    with pytest.raises(BadInputError, match="no such file"):
        make(name, weights=str(tmp_path / "absent.safetensors"))


# Files as OpenGVLab and Meta publish them, and what their networks compute, in plain torch.

WIDTH, HEADS, DEPTH, PATCH = 24, 2, 2, 8


def published_state(name: str) -> dict[str, Tensor]:
    """Random tensors under the names of the published files, without what wraps them."""
    jepa = name == "V-JEPA2.1"
    shapes: dict[str, tuple[int, ...]] = {
        "patch_embed.proj.weight": (WIDTH, 3, 2, PATCH, PATCH),
        "patch_embed.proj.bias": (WIDTH,),
    }
    for block in range(DEPTH):
        start = f"blocks.{block}."
        shapes |= {f"{start}attn.qkv.weight": (3 * WIDTH, WIDTH)}
        biases = ["qkv.bias"] if jepa else ["q_bias", "v_bias"]
        shapes |= {f"{start}attn.{b}": (WIDTH * (3 if jepa else 1),) for b in biases}
        shapes |= {f"{start}attn.proj.weight": (WIDTH, WIDTH), f"{start}attn.proj.bias": (WIDTH,)}
        shapes |= {
            f"{start}mlp.fc1.weight": (4 * WIDTH, WIDTH),
            f"{start}mlp.fc1.bias": (4 * WIDTH,),
        }
        shapes |= {f"{start}mlp.fc2.weight": (WIDTH, 4 * WIDTH), f"{start}mlp.fc2.bias": (WIDTH,)}
        shapes |= {
            f"{start}{n}.{p}": (WIDTH,) for n in ("norm1", "norm2") for p in ("weight", "bias")
        }
    if jepa:
        shapes |= {f"norms_block.{i}.{p}": (WIDTH,) for i in range(4) for p in ("weight", "bias")}
        shapes |= {"img_mod_embed": (1, 1, WIDTH), "video_mod_embed": (1, 1, WIDTH)}
        shapes |= {"patch_embed_img.proj.weight": (WIDTH, 3, 1, PATCH, PATCH)}
        shapes |= {"patch_embed_img.proj.bias": (WIDTH,)}
    else:
        shapes |= {"fc_norm.weight": (WIDTH,), "fc_norm.bias": (WIDTH,)}
    random = torch.Generator().manual_seed(3)
    return {n: 0.3 * torch.randn(shape, generator=random) for n, shape in shapes.items()}


def published_file(name: str, folder: Path) -> Path:
    state = published_state(name)
    if name == "VideoMAEv2":
        save_file({f"model.{n}": v for n, v in state.items()}, folder / "model.safetensors")
        return folder / "model.safetensors"
    encoder = {f"module.backbone.{n}": v for n, v in state.items()}
    other = {n: torch.zeros_like(v) for n, v in encoder.items()}
    torch.save({"encoder": other, "ema_encoder": encoder, "epoch": 7}, folder / "vjepa2_1.pt")
    return folder / "vjepa2_1.pt"


def turned(x: Tensor, positions: Tensor) -> Tensor:
    """Queries or keys, pairs of which are complex numbers that are multiplied by exp(i p w)."""
    size = x.shape[-1]
    rates = torch.tensor([10000 ** (-2 * pair / size) for pair in range(size // 2)])
    phases = torch.polar(torch.ones(len(positions), size // 2), positions[:, None] * rates)
    return torch.view_as_real(
        torch.view_as_complex(x.unflatten(-1, (-1, 2)).contiguous()) * phases
    ).flatten(-2)


def reference(name: str, state: dict[str, Tensor], clips: Tensor, blocks: int) -> Tensor:
    """Tokens of clips (B, T, 3, H, W) after a number of blocks, by the published definitions."""
    x = torch.nn.functional.conv3d(
        clips.transpose(1, 2), state["patch_embed.proj.weight"], state["patch_embed.proj.bias"],
        stride=(2, PATCH, PATCH),
    )  # fmt: skip
    times, side = x.shape[2], x.shape[3]
    x = x.flatten(2).transpose(1, 2)
    tokens = torch.arange(times * side * side)
    if name == "V-JEPA2.1":
        x = x + state["video_mod_embed"]
        scale = (256 // PATCH - 1) / (side - 1)
        where = [tokens // side**2, tokens % side**2 // side * scale, tokens % side * scale]
    else:
        rates = torch.tensor([10000 ** (-2 * (i // 2) / WIDTH) for i in range(WIDTH)])
        angles = tokens[:, None] * rates
        x = x + torch.where(torch.arange(WIDTH) % 2 == 0, angles.sin(), angles.cos())
        where = []
    for block in range(blocks):
        part = {
            n.removeprefix(f"blocks.{block}."): v
            for n, v in state.items() if n.startswith(f"blocks.{block}.")
        }  # fmt: skip
        y = norm(x, part, "norm1")
        if name == "V-JEPA2.1":
            bias = part["attn.qkv.bias"]
        else:
            bias = torch.cat([part["attn.q_bias"], torch.zeros(WIDTH), part["attn.v_bias"]])
        qkv = y @ part["attn.qkv.weight"].T + bias
        q, k, v = qkv.unflatten(-1, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        third = 2 * (WIDTH // HEADS // 3 // 2)
        for axis, positions in enumerate(where):
            cut = slice(axis * third, (axis + 1) * third)
            q = q.clone()
            k = k.clone()
            q[..., cut], k[..., cut] = (
                turned(q[..., cut], 1.0 * positions),
                turned(k[..., cut], 1.0 * positions),
            )
        weights = (q @ k.transpose(-1, -2) / (WIDTH / HEADS) ** 0.5).softmax(-1)
        y = (weights @ v).transpose(1, 2).flatten(2)
        x = x + y @ part["attn.proj.weight"].T + part["attn.proj.bias"]
        y = norm(x, part, "norm2") @ part["mlp.fc1.weight"].T + part["mlp.fc1.bias"]
        x = x + torch.nn.functional.gelu(y) @ part["mlp.fc2.weight"].T + part["mlp.fc2.bias"]
    return x


def norm(x: Tensor, state: dict[str, Tensor], name: str) -> Tensor:
    centred = x - x.mean(-1, keepdim=True)
    deviation = (centred.pow(2).mean(-1, keepdim=True) + 1e-6).sqrt()
    return centred / deviation * state[f"{name}.weight"] + state[f"{name}.bias"]


@pytest.mark.parametrize("name", NAMES[2:])
@pytest.mark.parametrize("layer", [None, 1, 2])
def test_published_files_give_what_the_published_networks_compute(
    name: str, layer: int | None, tmp_path: Path
) -> None:
    state = published_state(name)
    model = make(name, weights=str(published_file(name, tmp_path)), layer=layer, image_size=48)
    small = batch(pictures(4, 48))
    expected = reference(name, state, model_input(model, small), layer or DEPTH)
    if layer is None:
        expected = norm(expected, state, "fc_norm" if name == "VideoMAEv2" else "norms_block.3")
    tokens = model.network(model_input(model, small)).last_hidden_state
    torch.testing.assert_close(tokens, expected, rtol=1e-4, atol=1e-4)
    mean = expected.view(2, 2, 36, WIDTH).mean(2)
    torch.testing.assert_close(model.encode(small), mean, rtol=1e-4, atol=1e-4)
    assert model.name() == f"{name}{'' if layer is None else f'-layer{layer}'}-small"
    assert model.init.startswith("local:")


def test_a_layer_that_a_network_lacks_is_refused() -> None:
    with pytest.raises(BadInputError, match="has the layers 1 to 2, not 3"):
        make("V-JEPA2", layer=3)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "VideoMAEv2",
            {"small": (224, 16, 768, 12, 12, 3072), "paper": (224, 14, 1408, 40, 16, 6144)},
        ),
        (
            "V-JEPA2.1",
            {"small": (384, 16, 768, 12, 12, 3072), "paper": (384, 16, 1024, 24, 16, 4096)},
        ),
    ],
)
def test_sizes_are_as_published(name: str, expected: dict[str, tuple[int, ...]]) -> None:
    for size, numbers in expected.items():
        of_size = video_networks.FAMILIES[name].sizes[size]
        settings = video_networks.VideoSettings(**{"model": name, **of_size, "weights": "random"})
        assert numbers == (
            settings.image_size, settings.patch, settings.width, settings.depth, settings.heads,
            round(settings.mlp * settings.width),
        )  # fmt: skip


def test_weights_of_the_hub_are_asked_for_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = files(tmp_path)["VideoMAE"]
    asked = []

    def download(name: str, file: str) -> str:
        asked.append((name, file))
        return str(path)

    monkeypatch.setattr(video_networks, "hf_hub_download", download)
    model = make("VideoMAE", weights="hub:someone/some-model")
    assert asked == [("someone/some-model", "model.safetensors")]
    assert model.provenance().init == "hub:someone/some-model"
    assert model.provenance().encoder_pretraining_task == "", "which nobody said"
    assert model.digest() == make("VideoMAE", weights=str(path)).digest()


def test_a_hub_that_cannot_be_reached_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def download(name: str, file: str) -> str:
        raise huggingface_hub.errors.LocalEntryNotFoundError("no network\nsecond line")

    monkeypatch.setattr(video_networks, "hf_hub_download", download)
    with pytest.raises(BadInputError, match=r"'hub:a/b' could not be fetched .*no network.*random"):
        make("VideoMAE", weights="hub:a/b")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": 3}, "even number of frames, not 3"),
        ({"image_size": 30}, "not 30 of 8"),
        ({"heads": 5}, "not 24 of 5"),
        ({"depth": 0}, "at least 1"),
        ({"size": "released"}, "has the sizes small, paper, not 'released'"),
        ({"frames": 24}, "span 47 frames"),
    ],
)
def test_settings_that_make_no_network_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        make("VideoMAE", **options)


@pytest.mark.nightly
@pytest.mark.slow
def test_without_transformers_the_extra_is_named() -> None:
    code = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name == "transformers":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
from physion.core.errors import MissingExtraError
from physion.models.build import build_model
try:
    build_model("VideoMAE")
except MissingExtraError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "-e '.[video]'" in done.stdout
