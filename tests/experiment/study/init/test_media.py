"""Media of a study: cut movies, clean maps, content hashes as names, links refused."""

from __future__ import annotations

import hashlib
import io
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from physion.core.errors import BadInputError
from physion.experiment.study.make import StimulusSource, clean_map, import_stimulus
from physion.trials.video import encode_movie, read_frames
from support.experiment.tiny_study import FULL, OBSERVED, draw, draw_map, read_number

SIZE = 64


@pytest.fixture
def source(tmp_path: Path) -> StimulusSource:
    """Return a familiarization stimulus in its own folder."""
    folder = tmp_path / "dataset"
    folder.mkdir()
    frames = draw(1, True, SIZE)
    (folder / "a_img.mp4").write_bytes(encode_movie(frames))
    (folder / "a_observed.mp4").write_bytes(encode_movie(frames[:OBSERVED]))
    (folder / "a_map.png").write_bytes(draw_map(1, SIZE))
    return StimulusSource(
        "a", "collide", "familiarization", 0, True, "free", folder / "a_img.mp4",
        folder / "a_map.png", folder / "a_observed.mp4",
    )  # fmt: skip


@pytest.fixture
def study(tmp_path: Path) -> Path:
    folder = tmp_path / "study"
    (folder / "media").mkdir(parents=True)
    return folder


def test_our_movies_are_copied_as_they_are(source: StimulusSource, study: Path) -> None:
    found = import_stimulus(source, study)
    assert source.observed is not None
    assert (study / found.movie).read_bytes() == source.observed.read_bytes()
    assert (study / found.full).read_bytes() == source.movie.read_bytes()
    assert (found.frames, found.full_frames, found.rate) == (OBSERVED, FULL, 30.0)
    assert (found.width, found.height, found.label) == (SIZE, SIZE, True)


def test_names_match_the_content(source: StimulusSource, study: Path) -> None:
    found = import_stimulus(source, study)
    for name in (found.movie, found.map, found.full):
        assert Path(name).stem == hashlib.sha256((study / name).read_bytes()).hexdigest()
    assert len(list((study / "media").iterdir())) == 3


def test_test_stimuli_come_without_their_end(source: StimulusSource, study: Path) -> None:
    found = import_stimulus(replace(source, phase="test"), study)
    assert (found.full, found.full_frames) == ("", 0)
    assert {path.name for path in (study / "media").iterdir()} == {
        Path(found.movie).name,
        Path(found.map).name,
    }


def test_a_whole_movie_is_cut_to_exactly_the_observed_frames(
    source: StimulusSource, study: Path
) -> None:
    found = import_stimulus(replace(source, observed=None, phase="test"), study)
    frames = read_frames(study / found.movie)
    assert [read_number(frame) for frame in frames] == list(range(OBSERVED))
    whole = read_frames(source.movie)
    assert np.abs(frames.astype(int) - whole[:OBSERVED]).mean() < 2
    # No packet and no bytes of a later picture: the container ends with the last frame.
    with av.open(str(study / found.movie)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    assert len(packets) == OBSERVED


def test_an_observed_movie_of_more_frames_is_refused(source: StimulusSource, study: Path) -> None:
    assert source.observed is not None
    source.observed.write_bytes(encode_movie(draw(1, True, SIZE)[: OBSERVED + 1]))
    with pytest.raises(BadInputError, match="46 frames, not the 45") as raised:
        import_stimulus(source, study)
    assert str(source.observed) in str(raised.value)
    source.observed.write_bytes(encode_movie(draw(1, True, SIZE)[: OBSERVED - 1]))
    with pytest.raises(BadInputError, match="44 frames, not the 45"):
        import_stimulus(source, study)
    assert not list((study / "media").iterdir())


def test_a_movie_that_is_too_short_is_refused(source: StimulusSource, study: Path) -> None:
    source.movie.write_bytes(encode_movie(draw(1, True, SIZE)[: OBSERVED - 5]))
    with pytest.raises(BadInputError, match="40 frames, not 45"):
        import_stimulus(replace(source, observed=None, phase="test"), study)
    source.movie.write_bytes(encode_movie(draw(1, True, SIZE)[:OBSERVED]))
    with pytest.raises(BadInputError, match="none after the 45"):
        import_stimulus(source, study)


def test_a_faster_movie_than_screens_is_refused(source: StimulusSource, study: Path) -> None:
    source.movie.write_bytes(encode_movie(draw(1, True, SIZE), rate=100))
    with pytest.raises(BadInputError, match="--playback slow"):
        import_stimulus(replace(source, observed=None), study)


def test_whole_and_observed_movies_must_fit(source: StimulusSource, study: Path) -> None:
    source.movie.write_bytes(encode_movie(draw(1, True, 2 * SIZE)))
    with pytest.raises(BadInputError, match=r"128 x 128 .* observed part 64 x 64"):
        import_stimulus(source, study)


@pytest.mark.parametrize("what", ["audio", "yuv444p", "untagged"])
def test_what_browsers_may_not_play_rightly_is_encoded_again(
    source: StimulusSource, study: Path, what: str
) -> None:
    foreign = _foreign(what)
    assert source.observed is not None
    source.observed.write_bytes(foreign)
    found = import_stimulus(replace(source, phase="test"), study)
    assert (study / found.movie).read_bytes() != foreign
    with av.open(str(study / found.movie)) as container:
        stream = container.streams.video[0]
        assert len(container.streams) == 1 and stream.codec_context.pix_fmt == "yuv420p"
        assert int(stream.codec_context.colorspace) == 1
    numbers = [read_number(frame) for frame in read_frames(study / found.movie)]
    assert numbers == list(range(OBSERVED))


def test_files_that_do_not_match_the_index_are_refused(source: StimulusSource, study: Path) -> None:
    with pytest.raises(BadInputError, match="index"):
        import_stimulus(replace(source, digests={"observed": "0" * 64}), study)


@pytest.mark.parametrize("name", ["movie", "observed", "map"])
def test_links_are_not_followed(source: StimulusSource, study: Path, name: str) -> None:
    path: Path = getattr(source, name)
    path.rename(path.with_suffix(".moved"))
    path.symlink_to(path.with_suffix(".moved"))
    with pytest.raises(BadInputError, match=r"link|not a regular file"):
        import_stimulus(source, study)


def test_a_link_in_the_study_is_replaced_by_the_file(source: StimulusSource, study: Path) -> None:
    found = import_stimulus(source, study)
    outside = study.parent / "outside.mp4"
    outside.write_bytes((study / found.movie).read_bytes())
    (study / found.movie).unlink()
    (study / found.movie).symlink_to(outside)
    import_stimulus(source, study)
    assert not (study / found.movie).is_symlink()


@pytest.mark.parametrize("damage", [b"", b"not a movie", None])
def test_damaged_movies_are_refused(
    source: StimulusSource, study: Path, damage: bytes | None
) -> None:
    assert source.observed is not None
    whole = source.observed.read_bytes()
    source.observed.write_bytes(whole[: len(whole) * 2 // 3] if damage is None else damage)
    with pytest.raises(BadInputError, match=r"a_observed\.mp4"):
        import_stimulus(source, study)


# --- maps ----------------------------------------------------------------------------------------


def test_a_map_keeps_its_pixels_and_nothing_else() -> None:
    from PIL.PngImagePlugin import PngInfo

    words = PngInfo()
    words.add_text("Comment", "contact: True")
    picture = Image.open(io.BytesIO(draw_map(0, SIZE)))
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", pnginfo=words)
    assert b"contact" in buffer.getvalue()
    cleaned = clean_map(buffer.getvalue(), (SIZE, SIZE), Path("a_map.png"))
    assert b"contact" not in cleaned
    again = Image.open(io.BytesIO(cleaned))
    assert np.array_equal(np.asarray(again), np.asarray(picture))


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("no red", "no red for the agent"),
        ("no yellow", "no yellow for the patient"),
        ("opaque", "no transparent pixel"),
        ("size", "32 x 32 pixels, its movie 64 x 64"),
        ("jpeg", "not a readable PNG"),
        ("cut short", "not a readable PNG"),
    ],
)
def test_maps_that_point_out_nothing_are_refused(case: str, message: str) -> None:
    pixels = np.asarray(Image.open(io.BytesIO(draw_map(0, 32 if case == "size" else SIZE)))).copy()
    if case == "no red":
        pixels[(pixels[..., 1] == 0)] = 0
    elif case == "no yellow":
        pixels[(pixels[..., 1] == 255)] = 0
    elif case == "opaque":
        pixels[..., 3] = 255
    buffer = io.BytesIO()
    picture = Image.fromarray(pixels)
    if case == "jpeg":
        picture.convert("RGB").save(buffer, "JPEG")
    else:
        picture.save(buffer, "PNG")
    content = buffer.getvalue()[:-40] if case == "cut short" else buffer.getvalue()
    with pytest.raises(BadInputError, match=message) as raised:
        clean_map(content, (SIZE, SIZE), Path("a_map.png"))
    assert "a_map.png" in str(raised.value)


def _foreign(what: str) -> bytes:
    """Write the observed frames as a foreign movie: with sound, other colours, no tag."""
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width = stream.height = SIZE
        stream.pix_fmt = "yuv444p" if what == "yuv444p" else "yuv420p"
        if what != "untagged":
            stream.codec_context.colorspace = 1
        sound = container.add_stream("aac", rate=48_000) if what == "audio" else None
        for number, frame in enumerate(draw(1, True, SIZE)[:OBSERVED]):
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            picture.pts = number
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
        if sound is not None:
            silence = av.AudioFrame.from_ndarray(
                np.zeros((1, 1024), np.float32), format="fltp", layout="mono"
            )
            silence.sample_rate = 48_000
            container.mux(sound.encode(silence))
            container.mux(sound.encode())
    return buffer.getvalue()
