"""Movies: encoding, exact reading, errors for damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.trials.video import MovieEncoder, count_frames, encode_movie, read_frames

NAMED = {"red": (255, 0, 0), "yellow": (255, 255, 0), "carpet": (30, 60, 160), "grey": (128,) * 3}


def moving_square(frames: int, size: int = 64) -> NDArray[np.uint8]:
    """A grey room in which a red square moves one pixel a frame."""
    movie = np.full((frames, size, size, 3), 128, np.uint8)
    for index in range(frames):
        movie[index, 20:36, index % (size - 16) : index % (size - 16) + 16] = NAMED["red"]
    return movie


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("movie") / "square.mp4"
    path.write_bytes(encode_movie(moving_square(60)))
    return path


def test_round_trip_keeps_every_frame_and_its_place(movie: Path) -> None:
    source, read = moving_square(60), read_frames(movie)
    assert read.shape == source.shape
    # Chroma has half the resolution, so edges blur: the middle of the square is compared.
    for index in range(60):
        left = index % 48
        assert (
            np.abs(read[index, 24:32, left + 4 : left + 12].astype(int) - NAMED["red"]).max() < 12
        )
    assert np.abs(read.astype(int) - source).mean() < 2


@pytest.mark.parametrize("name", sorted(NAMED))
def test_colours_survive(name: str, tmp_path: Path) -> None:
    source = np.full((3, 32, 32, 3), NAMED[name], np.uint8)
    (tmp_path / "c.mp4").write_bytes(encode_movie(source))
    for size in (None, (32, 32), (16, 24), (64, 64)):
        read = read_frames(tmp_path / "c.mp4", size=size)
        assert np.abs(read.astype(int) - NAMED[name]).max() <= 3


def test_start_count_and_stride_pick_the_same_frames_as_slicing(movie: Path) -> None:
    everything = read_frames(movie)
    np.testing.assert_array_equal(
        read_frames(movie, start=7, count=5, stride=3), everything[7:22:3]
    )
    np.testing.assert_array_equal(read_frames(movie, stride=10), everything[::10])


def test_size_scales_by_averaging(movie: Path) -> None:
    small = read_frames(movie, count=4, size=(32, 16))
    assert small.shape == (4, 32, 16, 3)
    blocks = read_frames(movie, count=4).reshape(4, 32, 2, 16, 4, 3).mean((2, 4))
    assert np.abs(small - blocks).mean() < 2


def test_same_frames_same_bytes_and_index_before_pictures(movie: Path) -> None:
    data = movie.read_bytes()
    assert encode_movie(moving_square(60)) == data
    assert 0 < data.find(b"moov") < data.find(b"mdat")
    assert count_frames(movie) == 60


@pytest.mark.parametrize("frames", [1, 45, 302, 2000])
def test_any_length_fits_its_index(frames: int, tmp_path: Path) -> None:
    (tmp_path / "m.mp4").write_bytes(encode_movie(moving_square(frames, 32)))
    assert len(read_frames(tmp_path / "m.mp4", size=(2, 2))) == frames


@pytest.mark.parametrize("kept", [0, 10, 300, 0.5, 0.9, 0.999])
def test_cut_movie_is_refused_by_name(movie: Path, kept: float, tmp_path: Path) -> None:
    data = movie.read_bytes()
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(data[: int(kept if kept > 1 else kept * len(data))])
    with pytest.raises(BadInputError, match=r"cut\.mp4"):
        read_frames(cut)


def test_missing_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="missing"):
        read_frames(tmp_path / "none.mp4")
    (tmp_path / "text.mp4").write_text("this is no movie\n" * 100)
    with pytest.raises(BadInputError, match=r"text\.mp4"):
        read_frames(tmp_path / "text.mp4")


def test_asking_past_the_end_is_an_error_not_a_shorter_clip(movie: Path) -> None:
    with pytest.raises(BadInputError, match="it has 60"):
        read_frames(movie, count=61)


def test_odd_sizes_and_wrong_frames_are_refused() -> None:
    with pytest.raises(BadInputError, match="even"):
        MovieEncoder(63, 64, 1)
    encoder = MovieEncoder(64, 64, 2)
    with pytest.raises(BadInputError, match="frame 0"):
        encoder.add(np.zeros((32, 64, 3), np.uint8))
    encoder.add(np.zeros((64, 64, 3), np.uint8))
    with pytest.raises(BadInputError, match="1 frames, not 2"):
        encoder.finish()
