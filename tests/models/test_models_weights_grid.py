"""Grid features keep positions; pooled ones do not."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from physion.core.errors import BadInputError
from physion.models.encoders.weights import (
    EncoderWeights,
    GridFeatures,
    create_encoder,
    feature_size,
)

RANDOM = EncoderWeights("random")


class _Map(nn.Module):
    """Encoder whose features are given."""

    def __init__(self, features: Tensor, channels: int, prefix: int = 0) -> None:
        super().__init__()
        self.features, self.num_features, self.num_prefix_tokens = features, channels, prefix

    def forward_features(self, pictures: Tensor) -> Tensor:
        return self.features


def _cells(rows: int, columns: int) -> Tensor:
    """Map (1, 2, rows, columns) whose channels are row and column."""
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return torch.stack([row, column])[None].float()


def test_cells_are_in_the_order_of_rows_columns_channels() -> None:
    features = GridFeatures(_Map(_cells(8, 8), 2), "a")(torch.zeros(1))
    expected = [[[2 * row + 0.5, 2 * column + 0.5] for column in range(4)] for row in range(4)]
    assert features.tolist() == [torch.tensor(expected).flatten().tolist()]


def test_a_map_smaller_than_the_grid_is_kept() -> None:
    features = GridFeatures(_Map(_cells(2, 2), 2), "a")(torch.zeros(1))
    assert features.tolist() == [[0, 0, 0, 1, 1, 0, 1, 1]]


def test_cells_of_seven_rows_overlap_by_one() -> None:
    features = GridFeatures(_Map(_cells(7, 7), 2), "a")(torch.zeros(1)).view(4, 4, 2)
    assert features[:, 0, 0].tolist() == [0.5, 2.0, 4.0, 5.5]


@pytest.mark.parametrize("prefix", [0, 1, 5])
def test_patch_tokens_are_a_map_without_class_and_register_tokens(prefix: int) -> None:
    tokens = _cells(8, 8).flatten(2).transpose(1, 2)
    tokens = torch.cat([torch.full((1, prefix, 2), 1e6), tokens], 1)
    features = GridFeatures(_Map(tokens, 2, prefix), "a")(torch.zeros(1))
    assert torch.equal(features, GridFeatures(_Map(_cells(8, 8), 2), "a")(torch.zeros(1)))


def test_channels_may_come_last() -> None:
    last = _cells(8, 8).permute(0, 2, 3, 1)
    features = GridFeatures(_Map(last, 2), "a")(torch.zeros(1))
    assert torch.equal(features, GridFeatures(_Map(_cells(8, 8), 2), "a")(torch.zeros(1)))


@pytest.mark.parametrize("shape", [(1, 7, 2), (1, 2)])
def test_without_a_square_map_there_is_no_grid(shape: tuple[int, ...]) -> None:
    with pytest.raises(BadInputError, match=r"'a' has no square feature map; use pooling=pooled"):
        GridFeatures(_Map(torch.zeros(shape), 2), "a")(torch.zeros(1))


@pytest.mark.parametrize(
    ("name", "image_size", "channels"),
    [("test_resnet", 128, 96), ("test_vit", 160, 64), ("test_efficientnet", 128, 256)],
)
def test_grid_features_follow_what_moves(name: str, image_size: int, channels: int) -> None:
    encoder = create_encoder(name, image_size, RANDOM, "grid")
    picture = torch.zeros(2, 3, image_size, image_size)
    half = image_size // 2
    picture[0, :, :half, :half] = 1
    picture[1, :, half:, half:] = 1
    features = encoder(picture)
    assert features.shape == (2, 16 * channels)
    assert feature_size(name, image_size, "grid") == 16 * channels
    assert feature_size(name, image_size) == channels
    change = (features[0] - features[1]).view(4, 4, channels).abs().mean(-1)
    assert change[0, 0] > 0 and change[3, 3] > 0 and not encoder.training
    assert not any(parameter.requires_grad for parameter in encoder.parameters())


def test_the_mean_of_the_cells_is_the_pooled_feature() -> None:
    picture = torch.randn(1, 3, 256, 256, generator=torch.Generator().manual_seed(0))
    grid = create_encoder("test_resnet", 256, RANDOM, "grid")(picture).view(16, -1).mean(0)
    pooled = create_encoder("test_resnet", 256, RANDOM)(picture)[0]
    assert torch.allclose(grid, pooled, atol=1e-5)


def test_pooling_has_two_values() -> None:
    for build in (
        lambda: feature_size("test_resnet", 64, "max"),  # type: ignore[arg-type]
        lambda: create_encoder("test_resnet", 64, RANDOM, "max"),  # type: ignore[arg-type]
    ):
        with pytest.raises(BadInputError, match="pooling must be pooled or grid, not 'max'"):
            build()
