"""Weights of encoders: seeded, named in the tables, and never executed."""

from __future__ import annotations

import ast
import hashlib
import pickle
import socket
from pathlib import Path
from typing import Any

import pytest
import timm
import torch
from huggingface_hub import constants as hub
from safetensors.torch import save_file
from torch import Tensor, nn

import physion
from physion.core.errors import BadInputError
from physion.models import build_model
from physion.models.encoders.weights import EncoderWeights, create_encoder, read_state_dict

NAME, SIZE = "test_resnet", 64


@pytest.fixture(scope="module")
def picture() -> Tensor:
    return torch.randn(2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def trained() -> nn.Module:
    """Save an encoder with a classifier, as a training script would."""
    torch.manual_seed(5)
    model: nn.Module = timm.create_model(NAME, pretrained=False)
    return model.eval()


def test_random_encoders_depend_on_their_seed_alone(picture: Tensor) -> None:
    torch.manual_seed(1)
    first = create_encoder(NAME, SIZE, EncoderWeights("random", 3))(picture)
    torch.manual_seed(2)
    before = torch.random.get_rng_state()
    again = create_encoder(NAME, SIZE, EncoderWeights("random", 3))(picture)
    other = create_encoder(NAME, SIZE, EncoderWeights("random", 4))(picture)
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert torch.equal(torch.random.get_rng_state(), before), "the caller's randomness is its own"


@pytest.mark.parametrize("kind", ["safetensors", "pth", "wrapped"])
def test_local_files_give_the_network_that_was_saved(
    kind: str, tmp_path: Path, trained: nn.Module, picture: Tensor
) -> None:
    path = tmp_path / ("weights.safetensors" if kind == "safetensors" else "weights.pth")
    if kind == "safetensors":
        save_file(trained.state_dict(), path)
    else:
        state: dict[str, Any] = trained.state_dict()
        torch.save({"state_dict": state, "epoch": 3} if kind == "wrapped" else state, path)
    encoder = create_encoder(NAME, SIZE, EncoderWeights(str(path)))
    with torch.no_grad():
        expected = trained.forward_head(trained.forward_features(picture), pre_logits=True)  # type: ignore[operator]
        assert torch.allclose(encoder(picture), expected, atol=1e-6)
    assert not any(parameter.requires_grad for parameter in encoder.parameters())
    model = build_model("frozen-encoder", encoder=NAME, image_size=SIZE, weights=str(path))
    sha = hashlib.sha256(path.read_bytes()).hexdigest()
    assert model.provenance().init == f"local:{sha[:12]}"
    assert model.provenance().model == f"{NAME}-mlp"


def test_another_file_of_the_same_name_is_another_encoder(
    tmp_path: Path, trained: nn.Module
) -> None:
    path = tmp_path / "w.safetensors"
    digests = []
    for shift in (0.0, 1.0):
        save_file({k: v + shift for k, v in trained.state_dict().items()}, path)
        model = build_model("frozen-encoder", encoder=NAME, image_size=SIZE, weights=str(path))
        digests.append(model.encoder_digest())  # type: ignore[attr-defined]
    assert digests[0] != digests[1]


class _Evil:
    """Object that runs a command when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.target,))


@pytest.mark.parametrize("how", ["torch", "pickle"])
def test_malicious_pickle_is_refused_and_never_run(how: str, tmp_path: Path) -> None:
    target, path = tmp_path / "pwned", tmp_path / "weights.pth"
    if how == "torch":
        torch.save({"state_dict": {"a": torch.zeros(1)}, "x": _Evil(target)}, path)
    else:
        path.write_bytes(pickle.dumps(_Evil(target)))
    with pytest.raises(BadInputError, match=r"refused|cannot be read"):
        read_state_dict(path)
    assert not target.exists()


def test_a_refused_pickle_is_not_advised_to_be_run(tmp_path: Path) -> None:
    path = tmp_path / "weights.pth"
    torch.save({"x": _Evil(tmp_path / "pwned")}, path)
    with pytest.raises(BadInputError, match="save only the state dict") as error:
        read_state_dict(path)
    assert "weights_only" not in str(error.value)


@pytest.mark.parametrize("broken", [IndexError("pop"), TypeError("x"), AttributeError("y")])
def test_whatever_a_broken_pickle_raises_is_one_line(
    broken: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "weights.pth"
    torch.save({"a": torch.zeros(1)}, path)

    def load(*_: Any, **__: Any) -> None:
        raise broken

    monkeypatch.setattr(torch, "load", load)
    with pytest.raises(BadInputError, match=r"weights\.pth cannot be read as weights"):
        read_state_dict(path)


def test_an_old_torch_file_with_a_pickle_without_end_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    path.write_bytes(b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19..")
    with pytest.raises(BadInputError, match=r"weights\.pt (is refused|cannot be read)"):
        read_state_dict(path)


@pytest.mark.parametrize("name", ["w.pth", "w.safetensors"])
def test_damaged_missing_and_foreign_files_are_one_clear_error(
    name: str, tmp_path: Path, trained: nn.Module
) -> None:
    path = tmp_path / name
    with pytest.raises(BadInputError, match="no such file"):
        create_encoder(NAME, SIZE, EncoderWeights(str(path)))
    path.write_bytes(b"\x00" * 100)
    with pytest.raises(BadInputError, match=r"w\."):
        create_encoder(NAME, SIZE, EncoderWeights(str(path)))
    saver = save_file if name.endswith("tensors") else torch.save
    saver({"a": torch.zeros(3)}, path)
    with pytest.raises(BadInputError, match="another network"):
        create_encoder(NAME, SIZE, EncoderWeights(str(path)))


def test_weights_of_another_network_name_the_tensors_that_differ(
    tmp_path: Path, trained: nn.Module
) -> None:
    path = tmp_path / "w.safetensors"
    state = trained.state_dict()
    names = [key for key in state if "num_batches" not in key and "fc" not in key]
    changed = {key: value for key, value in state.items() if key not in names[:4]}
    changed[names[5]] = torch.zeros(2, 3)
    save_file({**changed, "other.weight": torch.zeros(1)}, path)
    with pytest.raises(BadInputError) as caught:
        create_encoder(NAME, SIZE, EncoderWeights(str(path)))
    text = str(caught.value)
    listed = ", ".join(repr(key) for key in names[:3])
    assert f"4 missing ({listed}, ...)" in text
    assert "1 unexpected ('other.weight')" in text
    assert f"1 of another shape ({names[5]!r} (2, 3) for {tuple(state[names[5]].shape)})" in text
    assert "\n" not in text


def test_a_larger_network_that_holds_a_smaller_one_is_refused(tmp_path: Path) -> None:
    """All tensors of resnet18 are in resnet34, with equal shapes."""
    path = tmp_path / "w.safetensors"
    save_file(timm.create_model("resnet34", pretrained=False).state_dict(), path)
    with pytest.raises(BadInputError, match=r"\d+ unexpected \('layer1\.2"):
        create_encoder("resnet18", SIZE, EncoderWeights(str(path)))


def test_weights_of_a_converted_network_that_do_not_fit_are_one_clear_error(
    tmp_path: Path, trained: nn.Module
) -> None:
    """timm's converter for transformers fails on its own for a convolutional network."""
    path = tmp_path / "w.safetensors"
    save_file(trained.state_dict(), path)
    with pytest.raises(BadInputError, match=r"'test_vit': its tensors differ, \d+ missing"):
        create_encoder("test_vit", 160, EncoderWeights(str(path)))


def test_counters_of_batches_may_be_missing(
    tmp_path: Path, trained: nn.Module, picture: Tensor
) -> None:
    path = tmp_path / "w.safetensors"
    state = {k: v for k, v in trained.state_dict().items() if "num_batches" not in k}
    assert len(state) < len(trained.state_dict())
    save_file(state, path)
    encoder = create_encoder(NAME, SIZE, EncoderWeights(str(path)))
    expected = trained.forward_head(trained.forward_features(picture), pre_logits=True)  # type: ignore[operator]
    assert torch.allclose(encoder(picture), expected, atol=1e-6)


def test_unreachable_imagenet_weights_name_the_alternatives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real = timm.create_model

    def offline(name: str, pretrained: bool = False, **options: Any) -> nn.Module:
        if pretrained:
            raise OSError("Name or service not known")
        return real(name, pretrained=False, **options)

    monkeypatch.setattr(timm, "create_model", offline)
    with pytest.raises(BadInputError, match="weights=random") as caught:
        create_encoder(NAME, SIZE, EncoderWeights("imagenet"))
    assert "Name or service not known" in str(caught.value)


@pytest.mark.parametrize("reachable", [True, False])
def test_without_a_network_only_the_local_cache_is_asked(
    reachable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, seen = timm.create_model, []

    class Connection:
        def close(self) -> None: ...

    def connect(*where: Any, timeout: float) -> Connection:
        if not reachable:
            raise OSError("Name or service not known")
        return Connection()

    def create(name: str, pretrained: bool = False, **options: Any) -> nn.Module:
        seen.append(hub.HF_HUB_OFFLINE)
        return real(name, pretrained=False, **options)

    monkeypatch.setattr(timm, "create_model", create)
    monkeypatch.setattr(socket, "create_connection", connect)
    monkeypatch.setattr(hub, "HF_HUB_OFFLINE", False)
    for name in ("https_proxy", "HTTPS_PROXY"):
        monkeypatch.delenv(name, raising=False)
    create_encoder(NAME, SIZE, EncoderWeights("imagenet"))
    assert seen == [not reachable] and hub.HF_HUB_OFFLINE is False


@pytest.mark.slow
def test_vgg_features_come_before_the_last_relu() -> None:
    encoder = create_encoder("vgg11", 32, EncoderWeights("random"))
    features = encoder(torch.randn(2, 3, 32, 32))
    assert features.shape == (2, 4096)
    assert (features < 0).any() and (features > 0).any()


def test_no_module_reads_anything_that_could_run_code() -> None:
    """Of all modules of the package, seen as syntax trees."""
    found = []
    for path in Path(physion.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            name = ast.unparse(node.func)
            words = {k.arg: ast.unparse(k.value) for k in node.keywords}
            bad = name in {"eval", "exec", "pickle.load", "pickle.loads", "joblib.load"}
            bad |= name in {"yaml.load", "yaml.unsafe_load", "dill.load", "os.system"}
            bad |= name == "torch.load" and words.get("weights_only") != "True"
            bad |= words.get("allow_pickle") == "True" or words.get("shell") == "True"
            if bad:
                found.append(f"{path.name}:{node.lineno} {name}")
    assert found == []
