"""Movies: written and read, also when they are damaged."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.trials.video import (
    GROUP,
    MovieDecoder,
    MovieEncoder,
    MovieProperties,
    count_frames,
    encode_movie,
    read_chosen,
    read_frames,
)

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
    np.testing.assert_array_equal(read_frames(movie, stride=10), read[::10])


@pytest.mark.parametrize("name", sorted(NAMED))
def test_colours_survive(name: str, tmp_path: Path) -> None:
    source = np.full((3, 32, 32, 3), NAMED[name], np.uint8)
    (tmp_path / "c.mp4").write_bytes(encode_movie(source))
    for size in (None, (32, 32), (16, 24), (64, 64)):
        read = read_frames(tmp_path / "c.mp4", size=size)
        assert np.abs(read.astype(int) - NAMED[name]).max() <= 3


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


def test_odd_sizes_and_wrong_frames_are_refused() -> None:
    with pytest.raises(BadInputError, match="even"):
        MovieEncoder(63, 64, 1)
    encoder = MovieEncoder(64, 64, 2)
    with pytest.raises(BadInputError, match="frame 0"):
        encoder.add(np.zeros((32, 64, 3), np.uint8))
    encoder.add(np.zeros((64, 64, 3), np.uint8))
    with pytest.raises(BadInputError, match="1 frames, not 2"):
        encoder.finish()


# Seeking in movies: the same pictures as decoding from the start, at a cost without the start.


FRAMES, HEIGHT, WIDTH = 100, 48, 64
SIZES: tuple[tuple[int, int] | None, ...] = (None, (24, 32), (17, 40), (96, 96))


def drifting_noise() -> NDArray[np.uint8]:
    """Smooth noise that moves, with a cut at frame 37: movies with all kinds of pictures."""
    rng = np.random.default_rng(3)
    pictures = []
    for part, length in enumerate((37, FRAMES - 37)):
        coarse = rng.integers(0, 255, (HEIGHT // 8, WIDTH // 8, 3), np.uint8)
        wide = coarse.repeat(8, 0).repeat(8, 1)
        pictures += [np.roll(wide, (part + 1) * frame, axis=1) for frame in range(length)]
    return np.stack(pictures)


@pytest.fixture(scope="module")
def noise(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("movie") / "noise.mp4"
    path.write_bytes(encode_movie(drifting_noise()))
    return path


@pytest.fixture(scope="module")
def from_start(noise: Path) -> dict[tuple[int, int] | None, NDArray[np.uint8]]:
    """All frames by size, decoded without a seek."""
    return {size: read_frames(noise, size=size) for size in SIZES}


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data(), size=st.sampled_from(SIZES))
def test_seeking_gives_the_bytes_of_decoding_from_the_start(
    noise: Path,
    from_start: dict[tuple[int, int] | None, NDArray[np.uint8]],
    data: st.DataObject,
    size: tuple[int, int] | None,
) -> None:
    start = data.draw(st.integers(0, FRAMES - 1), "start")
    stride = data.draw(st.integers(1, 40), "stride")
    count = data.draw(st.integers(1, len(range(start, FRAMES, stride))), "count")
    read = read_frames(noise, start=start, count=count, stride=stride, size=size)
    np.testing.assert_array_equal(read, from_start[size][start::stride][:count])


@settings(max_examples=100, deadline=None)
@given(frames=st.lists(st.integers(0, FRAMES - 1), min_size=1, max_size=12).map(sorted))
def test_any_increasing_frames_and_repeated_ones(
    noise: Path, from_start: dict[tuple[int, int] | None, NDArray[np.uint8]], frames: list[int]
) -> None:
    read = read_chosen(noise, frames, size=(24, 32))
    np.testing.assert_array_equal(read, from_start[24, 32][frames])


def test_frames_are_those_that_the_library_decodes_in_order(
    noise: Path, from_start: dict[tuple[int, int] | None, NDArray[np.uint8]]
) -> None:
    with av.open(str(noise)) as container:
        pictures = [picture.to_ndarray(format="rgb24") for picture in container.decode(video=0)]
    assert len(pictures) == FRAMES
    for index, found in enumerate(from_start[None].astype(np.int16)):
        away = [np.abs(found - picture).mean() for picture in pictures]
        assert np.argmin(away) == index  # the library takes the colours for those of BT.601


def count_decoded(monkeypatch: pytest.MonkeyPatch, noise: Path, start: int, stride: int) -> int:
    """Return how many pictures are decoded for five frames."""
    seen: list[int] = []
    index = MovieDecoder._index

    def counted(self: MovieDecoder, picture: av.VideoFrame) -> int:
        seen.append(index(self, picture))
        return seen[-1]

    monkeypatch.setattr(MovieDecoder, "_index", counted)
    read_frames(noise, start=start, count=5, stride=stride)
    monkeypatch.undo()
    return len(seen)


@pytest.mark.parametrize("start", [0, 1, 14, 15, 29, 44, 60, 95])
def test_at_most_a_group_more_is_decoded_than_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, noise: Path, start: int
) -> None:
    assert 5 <= count_decoded(monkeypatch, noise, start, 1) < 5 + GROUP


def test_groups_between_two_frames_are_left_out(
    monkeypatch: pytest.MonkeyPatch, noise: Path
) -> None:
    assert count_decoded(monkeypatch, noise, 0, 20) <= 1 + 4 * GROUP - 15 < 80


FOREIGN: dict[str, tuple[str, dict[str, str], int]] = {
    "open groups": (
        "libx264",
        {"x264-params": "open-gop=1:keyint=20:min-keyint=20:bframes=3:b-adapt=0:scenecut=0"},
        0,
    ),
    "long groups": ("libx264", {}, 0),
    "no key frames": ("libx264", {"x264-params": "intra-refresh=1:keyint=20"}, 0),
    "changing rate": ("libx264", {"g": "15"}, 7),
    "another codec": ("mpeg4", {"g": "12", "bf": "2"}, 0),
}
"""Movies of other programs: codec, its options, and frames left out in the middle."""


@pytest.mark.parametrize("kind", sorted(FOREIGN))
def test_movies_of_other_programs_are_read_as_from_the_start(kind: str, tmp_path: Path) -> None:
    codec, options, gap = FOREIGN[kind]
    path = tmp_path / "foreign.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for index, picture in enumerate(drifting_noise()):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = index + gap * (index > 30), Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    everything = read_frames(path)
    assert len(everything) == FRAMES
    for start in range(0, FRAMES, 7):
        for stride in (1, 5, 22):
            count = min(4, len(range(start, FRAMES, stride)))
            read = read_frames(path, start=start, count=count, stride=stride)
            np.testing.assert_array_equal(read, everything[start::stride][:count])


def damage(noise: Path, folder: Path, first: float, last: float) -> Path:
    """Return a copy of which a range of bytes, as fractions of the file, is overwritten."""
    content = bytearray(noise.read_bytes())
    low, high = (int(part * len(content)) for part in (first, last))
    content[low:high] = b"\xff" * (high - low)
    path = folder / "bad.mp4"
    path.write_bytes(bytes(content))
    return path


@pytest.mark.parametrize("start", [60, 70, 90])
def test_damage_is_noticed_where_it_is_decoded(noise: Path, tmp_path: Path, start: int) -> None:
    bad = damage(noise, tmp_path, 0.55, 1.0)
    with pytest.raises(BadInputError, match=r"bad\.mp4 is (damaged|cut short)"):
        read_frames(bad, start=start, count=5)
    # What lies before is whole and is read.
    np.testing.assert_array_equal(read_frames(bad, count=5), read_frames(noise, count=5))


@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9])
def test_a_cut_movie_is_noticed_after_a_seek(noise: Path, tmp_path: Path, kept: float) -> None:
    content = noise.read_bytes()
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(BadInputError, match=r"cut\.mp4 is (damaged|cut short)"):
        read_frames(cut, start=95, count=5)


def test_random_damage_gives_the_frames_or_a_plain_error(noise: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    content = np.frombuffer(noise.read_bytes(), np.uint8)
    errors = []
    for _ in range(150):
        changed = content.copy()
        places = rng.integers(0, len(content), rng.integers(1, 30))
        changed[places] = rng.integers(0, 256, len(places))
        path = tmp_path / "bad.mp4"
        path.write_bytes(changed.tobytes())
        try:
            frames = read_chosen(path, [0, 50, 90], size=(24, 32))
        except BadInputError as error:
            errors.append(str(error))
        else:
            assert frames.shape == (3, 24, 32, 3)
    assert len(errors) > 20
    assert all("bad.mp4" in error and "\n" not in error for error in errors)


def test_properties_that_differ_from_the_expected_ones_are_named(noise: Path) -> None:
    known = MovieProperties(FRAMES, WIDTH, HEIGHT, 30.0)
    assert read_chosen(noise, [3], expected=known).shape == (1, HEIGHT, WIDTH, 3)
    for name, value in (("frames", 150), ("rate", 100.0), ("width", 256)):
        with pytest.raises(
            BadInputError, match=r"100 frames of 64 x 48 pixels at 30 a second, not"
        ):
            read_chosen(noise, [3], expected=known._replace(**{name: value}))


def test_frames_that_do_not_exist_or_decrease_are_refused(noise: Path) -> None:
    with pytest.raises(BadInputError, match="no frame 100: it has 100"):
        read_chosen(noise, [0, 100])
    for frames in ([], [-1, 3], [5, 4]):
        with pytest.raises(BadInputError, match="not decrease"):
            read_chosen(noise, frames)
    with pytest.raises(BadInputError, match="it has 0"):
        read_frames(noise, start=100, count=1)
    with pytest.raises(BadInputError, match="it has 100"):
        read_frames(noise, count=101)
