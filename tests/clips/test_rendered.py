"""Clips rendered from motions: what they show, and boxes that are not rendered twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from physion.clips import rendered
from physion.clips.batch import PIXELS, Motion, Spec
from physion.clips.clips import observed_source, whole_source
from physion.clips.movies import background
from physion.clips.rendered import MotionRenderer, boxes, object_ids
from physion.clips.source import ObservedSource, TrialReaders
from physion.clips.states import cut_motion
from physion.core.errors import BadInputError
from physion.rendering.camera import View
from physion.rendering.renderer import Frame, Renderer
from physion.scenes.looks import in_look
from physion.scenes.scene import Roles, Scene
from physion.trials.dataset import Dataset
from physion.trials.video import encode_movie
from support.official_hand_made import CLOTH, FRAMES, RIGID, SIZE, make_scene, make_trajectory

EVERYTHING = ("rgb", "ids", "depth", "boxes", "camera", "state")
SPEC = Spec(
    inputs=EVERYTHING, image_size=24, stride=7, context=4, future=3, context_at="start", objects=4
)


@pytest.fixture(scope="module")
def motions() -> dict[str, Motion]:
    texts = {name: make_scene(name, name == CLOTH).to_json() for name in (RIGID, CLOTH)}
    # As a file stores it, with 1.0 for 1: keys follow the text of a scene.
    scenes = {name: Scene.from_json(text) for name, text in texts.items()}
    return {name: Motion(scene, make_trajectory(scene)) for name, scene in scenes.items()}


def in_memory(
    motions: dict[str, Motion], spec: Spec = SPEC, look: str = "redyellow"
) -> ObservedSource:
    """Return a source of motions that are cut."""
    cut = {name: cut_motion(motion) for name, motion in motions.items()}
    inputs = [name for name in spec.inputs if name in PIXELS]
    looks = dict.fromkeys(cut, look)
    reader = MotionRenderer(cut, inputs, spec.image_size, spec.objects, looks)
    lengths = {name: len(motion.trajectory) for name, motion in cut.items()}
    state = cut if "state" in spec.inputs else None
    return ObservedSource(spec, TrialReaders(lengths, [reader] if inputs else [], state))


@pytest.mark.parametrize("look", ["redyellow", "free"])
@pytest.mark.parametrize("trial", [RIGID, CLOTH])
def test_rendered_pictures_are_those_that_the_movies_were_encoded_from(
    made: Dataset, trial: str, look: str
) -> None:
    spec = Spec(image_size=SIZE, stride=1, context=45, future=FRAMES - 45)
    paths = made.paths(trial)
    movie = paths.movie if look == "redyellow" else paths.free_movie
    observed = paths.observed_movie if look == "redyellow" else paths.free_observed_movie
    source = whole_source(made, spec, look=look, rendered=True)
    assert encode_movie(source.whole([trial]).rgb[0]) == movie.read_bytes()
    assert encode_movie(source.context([trial]).rgb[0]) == observed.read_bytes()


def test_inputs_match_the_renderer(made: Dataset, motions: dict[str, Motion]) -> None:
    batch = whole_source(made, SPEC, rendered=True).whole([RIGID, CLOTH])
    assert batch.frames.tolist() == [[0, 7, 14, 21, 28, 35, 42]] * 2
    for row, trial in enumerate(batch.trials):
        motion = motions[trial]
        scene = in_look(motion.scene, "redyellow")
        renderer = Renderer(scene, motion.trajectory, 24, 24)
        for step, frame in enumerate(batch.frames[row]):
            shown = renderer.render(int(frame), ("color", "depth", "ids"))
            np.testing.assert_array_equal(batch.rgb[row, step], shown.color)
            np.testing.assert_array_equal(batch.depth[row, step], shown.depth)
            ids = batch.ids[row, step]
            for name, number in {scene.roles.agent: 1, scene.roles.patient: 2}.items():
                index = scene.index(name) + 1
                np.testing.assert_array_equal(ids == number, shown.ids == index)
        assert batch.state is not None and batch.state[row].scene == motion.scene


def test_ids_number_agent_patient_and_others_and_leave_out_scenery() -> None:
    rigid, cloth = make_scene(RIGID, False), make_scene(CLOTH, True)
    assert rigid.names() == ["ball", "zone", "distractor_0", "cone"]
    # cone is the agent, zone the patient; the vase is scenery.
    assert object_ids(rigid).tolist() == [0, 3, 2, 0, 1]
    assert cloth.names()[-1] == "sheet" == cloth.roles.agent
    assert object_ids(cloth).tolist() == [0, 3, 2, 0, 4, 1]
    assert object_ids(cloth).dtype == np.uint8


def test_ids_that_do_not_fit_are_refused() -> None:
    scene = make_scene(RIGID, False)
    ball = scene.bodies[0]
    many = tuple(replace(ball, name=f"ball_{number}") for number in range(255))
    crowd = replace(scene, bodies=many, pushes=(), roles=Roles("ball_0", "ball_1"))
    assert object_ids(crowd).max() == 255
    crowd = replace(crowd, bodies=(*many, ball))
    with pytest.raises(BadInputError, match="256 objects"):
        object_ids(crowd)


def test_depth_is_infinite_where_nothing_is(motions: dict[str, Motion]) -> None:
    motion = motions[RIGID]
    alone = Motion(replace(motion.scene, room="empty"), motion.trajectory)
    source = in_memory({RIGID: alone}, replace(SPEC, inputs=("depth",)))
    depth = source.context([RIGID]).depth
    assert np.isposinf(depth).any() and (depth[np.isfinite(depth)] > 0.1).all()


def test_boxes_are_the_edges_of_visible_pixels() -> None:
    ids = np.zeros((2, 4, 8), np.uint8)
    ids[0, 1:3, 2:5] = 1
    ids[0, 3, 7] = 3
    ids[1, 0, 0] = 2
    found = boxes(ids, 4)
    assert found.shape == (2, 4, 4) and found.dtype == np.float32
    assert found[0, 0].tolist() == [2 / 8, 1 / 4, 5 / 8, 3 / 4]
    assert found[0, 2].tolist() == [7 / 8, 3 / 4, 1.0, 1.0]
    assert found[1, 1].tolist() == [0.0, 0.0, 1 / 8, 1 / 4]
    seen = [(0, 0), (0, 2), (1, 1)]
    assert sorted(zip(*np.nonzero(np.isfinite(found).all(-1)), strict=True)) == seen
    assert np.isnan(found).sum() == 4 * (8 - len(seen))
    # An object beyond the rows is left out.
    assert boxes(ids, 1).shape == (2, 1, 4) and np.isnan(boxes(ids, 1)[1]).all()


def test_boxes_of_a_batch_enclose_its_ids(motions: dict[str, Motion]) -> None:
    batch = in_memory(motions).context([RIGID, CLOTH])
    assert batch.boxes.shape == (2, 4, 4, 4)
    for row, step, number in np.ndindex(2, 4, 4):
        rows, columns = np.nonzero(batch.ids[row, step] == number + 1)
        box = batch.boxes[row, step, number] * 24
        if not len(rows):
            assert np.isnan(box).all()
            continue
        expected = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        np.testing.assert_allclose(box, expected, atol=1e-5)


def test_the_camera_projects_onto_the_pixels_of_the_ids(motions: dict[str, Motion]) -> None:
    """The agent's middle, through both matrices, lies on a pixel of the agent."""
    spec = replace(SPEC, image_size=64)
    batch = in_memory(motions, spec).context([RIGID])
    scene, trajectory = motions[RIGID].scene, motions[RIGID].trajectory
    view, projection = batch.camera[0]
    agent = scene.index(scene.roles.agent)
    point = np.append(trajectory.positions[0, agent] + [0, 0, 0.1], 1.0)
    clip = projection @ view @ point
    column, row = (clip[0] / clip[3] + 1) / 2 * 64, (1 - clip[1] / clip[3]) / 2 * 64
    pixels, _ = View(scene.camera, 64, 64).project(point[:3])
    np.testing.assert_allclose([column, row], pixels, atol=1e-9)
    assert batch.ids[0, 0, int(row), int(column)] == 1


def test_a_dataset_gives_the_same_as_its_motions(made: Dataset, motions: dict[str, Motion]) -> None:
    from_files = observed_source(made, SPEC, rendered=True)
    from_motions = in_memory(motions)
    both = [source.context([CLOTH, RIGID]) for source in (from_files, from_motions)]
    for name, values in both[0].arrays().items():
        np.testing.assert_array_equal(values, both[1].arrays()[name], name)
    assert from_files.key(RIGID, "context") == from_motions.key(RIGID, "context")


def test_movies_and_rendered_inputs_go_together_if_square(made: Dataset) -> None:
    spec = replace(SPEC, image_size=SIZE)
    mixed = observed_source(made, spec).context([RIGID])
    rendered = observed_source(made, spec, rendered=True).context([RIGID])
    np.testing.assert_array_equal(mixed.ids, rendered.ids)
    difference = np.abs(mixed.rgb.astype(int) - rendered.rgb).mean()
    assert 0 < difference < 8  # the encoder's rounding
    oblong = Dataset(made.folder)
    oblong.index["width"] = 64
    with pytest.raises(BadInputError, match=r"64 x 32 pixels.*rendered=True"):
        observed_source(oblong, spec)
    assert observed_source(oblong, spec, rendered=True).context([RIGID]).rgb.any()


def test_a_trial_without_motion_cannot_be_rendered(motions: dict[str, Motion]) -> None:
    motion = motions[RIGID]
    empty = replace(
        motion.trajectory,
        positions=np.full_like(motion.trajectory.positions, np.nan),
        engine="imported movie",
    )
    source = in_memory({RIGID: Motion(motion.scene, empty)})
    with pytest.raises(BadInputError, match=rf"{RIGID}.*without motion \(imported movie\)"):
        source.context([RIGID])


def test_keys_follow_motion_look_and_size(motions: dict[str, Motion]) -> None:
    def key(motion: Motion, spec: Spec = SPEC, look: str = "redyellow") -> str:
        return in_memory({RIGID: motion}, spec, look).key(RIGID, "context")

    motion = motions[RIGID]
    moved = replace(motion.trajectory, positions=motion.trajectory.positions + np.float32(0.01))
    seen_from = replace(motion.scene.camera, position=(3.0, 1.1, 1.5))
    keys = {
        key(motion),
        key(Motion(motion.scene, moved)),
        key(Motion(replace(motion.scene, camera=seen_from), motion.trajectory)),
        key(motion, look="free"),
        key(motion, replace(SPEC, image_size=32)),
        key(motion, replace(SPEC, objects=5)),
        key(motion, replace(SPEC, inputs=("state",))),
    }
    assert len(keys) == 7
    plain = replace(SPEC, inputs=("rgb",))
    assert key(motion, plain) == key(motion, replace(plain, objects=5))


# Boxes that were read before are not rendered again.


OBJECTS, SIDE = 4, 24
LOOKS = {RIGID: "redyellow", CLOTH: "redyellow"}


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, tuple[str, ...]]]:
    """Frames and passes that were rendered since the test began."""
    calls: list[tuple[int, tuple[str, ...]]] = []

    class Counting(Renderer):
        def render(self, frame: int, passes: Sequence[str] = ("color",)) -> Frame:
            calls.append((frame, tuple(passes)))
            return super().render(frame, passes)

    monkeypatch.setattr(rendered, "Renderer", Counting)
    return calls


def reader_of(motions: dict[str, Motion], *inputs: str) -> MotionRenderer:
    return MotionRenderer(motions, inputs, SIDE, OBJECTS, LOOKS)


def test_a_trial_that_is_read_again_is_rendered_as_a_whole_and_then_never(
    motions: dict[str, Motion], drawn: list[tuple[int, tuple[str, ...]]]
) -> None:
    reader = reader_of(motions, "boxes")
    windows = [np.array(frames) for frames in ([0, 6, 12], [12, 6, 0], [6, 18, 18], [40, 44, 49])]
    expected = [reader_of(motions, "boxes").read(RIGID, window)["boxes"] for window in windows]
    assert len(drawn) == 3 + 3 + 2 + 3
    drawn.clear()
    found = [reader.read(RIGID, window)["boxes"] for window in windows[:2]]
    assert drawn == [(frame, ("ids",)) for frame in (0, 6, 12)]
    found += [reader.read(RIGID, window)["boxes"] for window in windows[2:]]
    assert sorted(drawn) == [(frame, ("ids",)) for frame in range(FRAMES)]
    np.testing.assert_array_equal(found, expected)
    assert np.isfinite(found[0]).any() and not np.array_equal(found[0], found[3], equal_nan=True)
    reader.read(CLOTH, windows[0])
    assert len(drawn) == FRAMES + 3  # frames of another trial are others


def test_threads_may_share_a_reader(motions: dict[str, Motion]) -> None:
    reader = reader_of(motions, "boxes")
    requests = [np.arange(start, FRAMES, 9) for start in range(6)] * 3
    found = background(requests, partial(reader.read, CLOTH), ahead=6, threads=6)
    for window, values in zip(requests, found, strict=True):
        alone = reader_of(motions, "boxes").read(CLOTH, window)
        np.testing.assert_array_equal(values["boxes"], alone["boxes"])
