"""stimuli.csv, and the movies and maps of a study: imported, cleaned, checked."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from physion.cli.main import main
from physion.core.errors import BadInputError
from physion.experiment.study.make import StimulusSource, clean_map, import_stimulus
from physion.experiment.study.media import check_media
from physion.experiment.study.stimuli import COLUMNS, Stimulus, read_stimuli, write_stimuli
from physion.experiment.study.study import Study, load_study
from physion.trials.video import encode_movie, read_frames
from support.experiment.tiny_study import (
    FULL,
    OBSERVED,
    draw,
    draw_map,
    make_tiny_study,
    read_number,
)

NAMES_OF_COLUMNS = [column.name for column in COLUMNS]


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "stimuli.csv"
    odd = {"rate": 29.97002997002997, "scenario": "my-own.scenario", "look": "redyellow"}
    stimuli = [dataclasses.replace(each, **odd) for each in four_stimuli()]
    stimuli[0] = dataclasses.replace(stimuli[0], stimulus="00.1+a_b-c", width=16, height=4096)
    write_stimuli(path, stimuli)
    assert list(read_stimuli(path)) == stimuli


def test_a_spreadsheet_may_save_it_in_any_order_of_columns(tmp_path: Path) -> None:
    path = written_table(tmp_path)
    original = path.read_text()
    text = original.replace("True", "TRUE").replace("\n", "\r\n")
    path.write_bytes(b"\xef\xbb\xbf" + text.encode() + b",,,,,,,,,,,,,\r\n")
    assert list(read_stimuli(path)) == four_stimuli()
    rows = list(csv.reader(original.splitlines()))
    path.write_text("\n".join(",".join(reversed(row)) for row in rows))
    assert list(read_stimuli(path)) == four_stimuli()
    path.write_text(",".join(NAMES_OF_COLUMNS))
    with pytest.raises(BadInputError, match="no rows"):
        read_stimuli(path)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a formula for a name": ({"stimulus": "=1+1"}, "stimulus must be letters"),
    "a path for a name": ({"stimulus": "../x"}, "stimulus must be"),
    "an unknown phase": ({"phase": "main"}, "expected familiarization or test"),
    "an unknown look": ({"look": "blue"}, "expected free or redyellow"),
    "a label of another kind": ({"label": "contact"}, "expected True or False"),
    "no label": ({"label": ""}, "expected a value"),
    "a negative place": ({"place": "-1"}, "expected a whole number from 0"),
    "half a frame": ({"frames": "44.5"}, "expected a whole number from 1"),
    "no frame": ({"frames": "0"}, "expected a whole number from 1"),
    "no rate": ({"rate": "nan"}, "expected a number from 1 to 240"),
    "too high a rate": ({"rate": "241"}, "expected a number from 1 to 240"),
    "a rate in words": ({"rate": "slow"}, "expected a number"),
    "a tiny picture": ({"width": "15"}, "expected a whole number from 16"),
    "a movie outside": ({"movie": "media/../secret.json"}, "movie must be the path"),
    "a movie anywhere": ({"movie": "/etc/passwd"}, "movie must be the path"),
    "a movie below": ({"movie": "media/a/b.mp4"}, "movie must be the path"),
    "no map": ({"map": ""}, "expected a value"),
    "a whole movie in the test": ({"full": "media/a.mp4"}, "full must be empty"),
    "its frames in the test": ({"full_frames": "60"}, "full_frames must be 0"),
    "no whole movie to practise on": (
        {"phase": "familiarization", "full_frames": "60"}, "full must be the path"),
    "no later frame to practise on": (
        {"phase": "familiarization", "full": "media/w9.mp4", "full_frames": "45"},
        "more than the 45 observed"),
    "an outcome shown before": ({"movie": "media/w0.mp4"}, "full movie of row 1"),
    "a stimulus practised before": ({"stimulus": "a0"}, "is already in row 1"),
    "a place taken": ({"place": "0", "scenario": "collide"}, "place 0 of test"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_bad_rows_are_named(tmp_path: Path, case: str) -> None:
    change, message = REFUSED[case]
    path = written_table(tmp_path)
    rows = list(csv.DictReader(path.read_text().splitlines()))
    rows[3] |= change
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, NAMES_OF_COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    with pytest.raises(BadInputError, match="row 4") as raised:
        read_stimuli(path)
    assert message in str(raised.value) and str(path) in str(raised.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"look", b"lock", "unknown column 'lock'; closest: look"),
        (b",look", b",look,colour", "unknown column 'colour'"),
        (b"width,height", b"width,width", r"unknown column 'width\.1'"),
        (b",map,", b",", "rows have more cells than its header"),
        (b",place,", b",", "rows have more cells"),
        (b"45,0,30.0", b"45,30.0", "row 3 of column 'height' holds 'free'"),
        (b"a2", b'"a2', "is not a CSV table"),
        (b"a2", b"a\xff", "is not a CSV table"),
        (b"a2", b"a\x00", "stimulus must be|not a CSV table"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    path = written_table(tmp_path)
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(BadInputError, match=message):
        read_stimuli(path)


@pytest.mark.parametrize(
    ("first", "second"), [("s_1", "s-redyellow_1"), ("s_1", "s_1_img"), ("s_1_img.mp4", "s_1.hdf5")]
)
def test_names_that_are_one_to_the_analysis_are_refused(
    tmp_path: Path, first: str, second: str
) -> None:
    names = [first, "other", "a", second]
    rows = [dataclasses.replace(s, stimulus=n) for s, n in zip(four_stimuli(), names, strict=True)]
    path = tmp_path / "stimuli.csv"
    write_stimuli(path, rows)
    with pytest.raises(BadInputError, match="one stimulus to the analysis") as raised:
        read_stimuli(path)
    assert first in str(raised.value) and second in str(raised.value)
    rows[3] = dataclasses.replace(rows[3], scenario="drop")
    write_stimuli(path, rows)
    assert list(read_stimuli(path)) == rows


def four_stimuli() -> list[Stimulus]:
    """Return two familiarization and two test stimuli."""
    found = []
    for number in range(4):
        practice = number < 2
        found.append(
            Stimulus(
                f"a{number}", "collide", "familiarization" if practice else "test", number % 2,
                number % 2 == 0, f"media/m{number}.mp4", f"media/m{number}.png",
                f"media/w{number}.mp4" if practice else "", 45, 60 if practice else 0, 30.0, 128,
                128, "free",
            )
        )  # fmt: skip
    return found


def written_table(folder: Path) -> Path:
    path = folder / "stimuli.csv"
    write_stimuli(path, four_stimuli())
    return path


# --- import of movies and maps --------------------------------------------------------------------


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
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "study"
    (folder / "media").mkdir(parents=True)
    return folder


def test_our_movies_are_copied_as_they_are(source: StimulusSource, folder: Path) -> None:
    found = import_stimulus(source, folder)
    assert source.observed is not None
    assert (folder / found.movie).read_bytes() == source.observed.read_bytes()
    assert (folder / found.full).read_bytes() == source.movie.read_bytes()
    assert (found.frames, found.full_frames, found.rate) == (OBSERVED, FULL, 30.0)
    assert (found.width, found.height, found.label) == (SIZE, SIZE, True)
    # Names match the content.
    for name in (found.movie, found.map, found.full):
        assert Path(name).stem == hashlib.sha256((folder / name).read_bytes()).hexdigest()
    assert len(list((folder / "media").iterdir())) == 3


def test_a_whole_movie_is_cut_to_exactly_the_observed_frames(
    source: StimulusSource, folder: Path
) -> None:
    found = import_stimulus(replace(source, observed=None, phase="test"), folder)
    frames = read_frames(folder / found.movie)
    assert [read_number(frame) for frame in frames] == list(range(OBSERVED))
    whole = read_frames(source.movie)
    assert np.abs(frames.astype(int) - whole[:OBSERVED]).mean() < 2
    # No packet and no bytes of a later picture: the container ends with the last frame.
    with av.open(str(folder / found.movie)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    assert len(packets) == OBSERVED
    # A test stimulus comes without its end.
    assert (found.full, found.full_frames) == ("", 0)
    names = {Path(found.movie).name, Path(found.map).name}
    assert {path.name for path in (folder / "media").iterdir()} == names


def movie_of(frames: int, size: int = SIZE, rate: int = 30) -> bytes:
    return encode_movie(draw(1, True, size)[:frames], rate=rate)


@pytest.mark.parametrize(
    ("which", "content", "changed", "message"),
    [
        ("observed", movie_of(OBSERVED + 1), {}, r"a_observed\.mp4.*46 frames, not the 45"),
        ("observed", movie_of(OBSERVED - 1), {}, "44 frames, not the 45"),
        ("movie", movie_of(40), {"observed": None, "phase": "test"}, "40 frames, not 45"),
        ("movie", movie_of(OBSERVED), {}, "none after the 45"),
        ("movie", movie_of(FULL, rate=100), {"observed": None}, "--playback slow"),
        ("movie", movie_of(FULL, 2 * SIZE), {}, r"128 x 128 .* observed part 64 x 64"),
        ("observed", movie_of(OBSERVED), {"digests": {"observed": "0" * 64}}, "index"),
        ("observed", b"", {}, r"a_observed\.mp4"),
        ("observed", b"not a movie", {}, r"a_observed\.mp4"),
        ("observed", movie_of(OBSERVED)[:-2000], {}, r"a_observed\.mp4"),
    ],
    ids=range(10),
)
def test_movies_that_do_not_fit_are_refused(
    source: StimulusSource, folder: Path, which: str, content: bytes, changed: Any, message: str
) -> None:
    getattr(source, which).write_bytes(content)
    with pytest.raises(BadInputError, match=message):
        import_stimulus(replace(source, **changed), folder)
    assert not list((folder / "media").iterdir())


@pytest.mark.parametrize("what", ["audio", "yuv444p", "untagged"])
def test_what_browsers_may_not_play_rightly_is_encoded_again(
    source: StimulusSource, folder: Path, what: str
) -> None:
    foreign = foreign_movie(what)
    assert source.observed is not None
    source.observed.write_bytes(foreign)
    found = import_stimulus(replace(source, phase="test"), folder)
    assert (folder / found.movie).read_bytes() != foreign
    with av.open(str(folder / found.movie)) as container:
        stream = container.streams.video[0]
        assert len(container.streams) == 1 and stream.codec_context.pix_fmt == "yuv420p"
        assert int(stream.codec_context.colorspace) == 1
    numbers = [read_number(frame) for frame in read_frames(folder / found.movie)]
    assert numbers == list(range(OBSERVED))


@pytest.mark.parametrize("name", ["movie", "observed", "map"])
def test_links_are_not_followed(source: StimulusSource, folder: Path, name: str) -> None:
    path: Path = getattr(source, name)
    path.rename(path.with_suffix(".moved"))
    path.symlink_to(path.with_suffix(".moved"))
    with pytest.raises(BadInputError, match=r"link|not a regular file"):
        import_stimulus(source, folder)


def test_a_link_in_the_study_is_replaced_by_the_file(source: StimulusSource, folder: Path) -> None:
    found = import_stimulus(source, folder)
    outside = folder.parent / "outside.mp4"
    outside.write_bytes((folder / found.movie).read_bytes())
    (folder / found.movie).unlink()
    (folder / found.movie).symlink_to(outside)
    import_stimulus(source, folder)
    assert not (folder / found.movie).is_symlink()


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


def foreign_movie(what: str) -> bytes:
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


# --- a study whose media differ from stimuli.csv is not served ------------------------------------


@pytest.fixture
def study(tmp_path: Path) -> Study:
    return make_tiny_study(tmp_path, test=2, familiarization=2, size=64)


def test_a_movie_that_continues_is_refused(
    study: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    check_media(study)
    path = study.folder / study.stimuli[-1].movie
    path.write_bytes(encode_movie(draw(3, False, 64)[: OBSERVED + 1]))
    with pytest.raises(BadInputError, match=r"46 frames; stimuli\.csv says 45") as raised:
        check_media(load_study(study.folder))
    assert str(path) in str(raised.value)
    assert main(["experiment", "serve", str(study.folder), "--port", "0"]) == 2
    assert "46 frames" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "content"),
    [("movie", b""), ("movie", b"no movie"), ("movie", draw_map(0, 64)),
     ("map", b""), ("map", b"no map"), ("map", draw_map(0, 32))],
)  # fmt: skip
def test_what_is_no_movie_or_map_is_refused(study: Study, kind: str, content: bytes) -> None:
    first = study.stimuli[0]
    (study.folder / (first.full if kind == "movie" else first.map)).write_bytes(content)
    with pytest.raises(BadInputError, match=kind):
        check_media(study)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 44}, "has 45 frames; stimuli.csv says 44"),
        ({"width": 66}, "64 x 64 at 30"),
        ({"rate": 29.97}, "64 x 64 at 30"),
    ],
)
def test_rows_that_say_otherwise_are_refused(
    study: Study, change: dict[str, Any], message: str
) -> None:
    rows = (*study.stimuli[:-1], dataclasses.replace(study.stimuli[-1], **change))
    with pytest.raises(BadInputError, match=message):
        check_media(dataclasses.replace(study, stimuli=rows))
