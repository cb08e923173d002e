"""Presets of the package and of users, and scenes sampled from them."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import physion
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import SCENARIOS
from physion.core.seeds import named_seed, trial_seed
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.scenes.sampling.build import scenarios
from physion.scenes.sampling.parameters import check_params
from physion.scenes.sampling.sample import (
    DEFAULT,
    FAMILIARIZATION,
    Preset,
    default_presets,
    get_preset,
    load_presets,
    parse_presets,
    read_preset_file,
    sample_scene,
)
from support.sound_scenes import assert_seen, assert_valid, overlapping

ROOMS = {"box": "box", "tdw": "bright"}
"""Ours for the official ones."""


def all_presets() -> list[Preset]:
    return [preset for name in SCENARIOS for preset in load_presets(name).values()]


def published() -> list[Preset]:
    return [preset for preset in all_presets() if preset.published]


def test_every_published_configuration_is_a_preset_once() -> None:
    counts = Counter(preset.scenario for preset in published())
    assert counts == {
        "dominoes": 15,
        "support": 12,
        "collide": 24,
        "contain": 8,
        "drop": 20,
        "link": 8,
        "roll": 14,
        "drape": 11,
    }
    names = [preset.official for preset in published()]
    assert len(set(names)) == 112 and None not in names
    for preset in published():
        assert str(preset.official).endswith(preset.name) and preset.seed is not None
    assert all(preset.official is None for preset in all_presets() if not preset.published)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_presets_of_our_own_come_first(scenario: str) -> None:
    presets = load_presets(scenario)
    assert tuple(presets)[:3] == (DEFAULT, FAMILIARIZATION, "debug")
    for name in (DEFAULT, FAMILIARIZATION, "debug"):
        assert presets[name].about
        # Drape's own published one has just that name.
        assert presets[name].published is None or presets[name].official == FAMILIARIZATION
    plain = presets[FAMILIARIZATION].params.scenery
    assert plain.distractors == plain.occluders == 0
    practised = default_presets(scenario, FAMILIARIZATION)
    assert practised == (FAMILIARIZATION,)
    assert not set(practised) & set(default_presets(scenario, "testing"))


@pytest.mark.parametrize(
    "index",
    [0, *(pytest.param(i, marks=[pytest.mark.slow, pytest.mark.nightly]) for i in (1, 2))],
)
@pytest.mark.parametrize("preset", all_presets(), ids=lambda p: f"{p.scenario}/{p.name}")
def test_every_preset_draws_sound_scenes(preset: Preset, index: int) -> None:
    check_params(preset.params, preset.name)
    seed = trial_seed("test", preset.scenario, preset.name, index)
    scene = sample_scene(preset.scenario, seed, preset.params)
    assert_valid(scene)
    assert_seen(scene)
    assert not overlapping(scene)
    assert scene.room == preset.params.room
    scenery = preset.params.scenery
    assert sum(one.scenery for one in scene.bodies) == scenery.distractors + scenery.occluders


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_familiarization_has_both_outcomes(scenario: str) -> None:
    params = get_preset(scenario, FAMILIARIZATION).params
    outcomes: Counter[bool] = Counter()
    for index in range(16):
        scene = sample_scene(scenario, trial_seed("test", scenario, "practice", index), params)
        outcomes[label_contact(scene, simulate(scene, until_contact=True)).contact] += 1
        if min(outcomes[True], outcomes[False]) == 3:
            return
    raise AssertionError(f"each outcome comes at least three times in sixteen: {outcomes}")


def test_published_values_equal_the_tables(official: Path) -> None:
    stimuli = official / "stimuli"
    tested: Counter[str] = Counter()
    with (stimuli / "stimulus_names_and_labels.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            tested[re.sub(r"_\d{4}$", "", row["stim_ID"])] += 1
    shown: Counter[str] = Counter()
    touched: Counter[str] = Counter()
    with (stimuli / "readout_labels.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            name = re.sub(r"_\d{4}$", "", row[""])
            shown[name] += 1
            touched[name] += row["ground truth outcome"] == "True"
    known = {str(preset.official) for preset in published()}
    assert set(tested) | set(shown) <= known
    # People practised on these; they are in no table.
    assert all("familiarization" in name for name in known - set(tested) - set(shown))
    for preset in published():
        assert preset.published is not None and preset.official is not None
        numbers = preset.published
        assert numbers.tested == tested[preset.official], preset.official
        assert numbers.readout_trials == shown[preset.official], preset.official
        assert numbers.readout_contact == touched[preset.official], preset.official
        assert 0 <= numbers.contact <= numbers.trials and numbers.frames >= 150


def read_command_line(file: Path) -> dict[str, str]:
    """Return its options by name, written as ``--name=value`` or on two lines."""
    options: dict[str, str] = {}
    name = ""
    for word in file.read_text().split("\n"):
        if word.startswith("--"):
            name, _, value = word[2:].strip().partition("=")
            options[name] = value
        elif name:
            options[name] = word.strip()
    return options


def test_presets_have_the_values_of_the_command_lines_and_metadata(official: Path) -> None:
    checked = 0
    for preset in published():
        file = official / "scenes" / preset.scenario / str(preset.official) / "commandline_args.txt"
        if not file.is_file():
            continue
        line, scenery = read_command_line(file), preset.params.scenery
        assert int(line["seed"]) == preset.seed
        assert ROOMS[line.get("room", "box")] == preset.params.room, preset.name
        assert int(line.get("num_distractors", 0)) == scenery.distractors, preset.name
        assert int(line.get("num_occluders", 0)) == scenery.occluders, preset.name
        if scenery.occluders:
            assert float(line.get("occlusion_scale", 0.75)) == scenery.occlusion, preset.name
        records = json.loads((file.parent / "metadata.json").read_text())
        said = preset.published
        assert said is not None and said.trials == len(records), preset.name
        assert said.contact == sum(record["does_target_contact_zone"] for record in records)
        lengths = [record["num_frames"] for record in records]
        assert said.frames == pytest.approx(np.mean(lengths), abs=1), preset.name
        checked += 1
    assert checked >= 40


GOOD = """
scenario = "collide"
[presets.mine]
about = "A slow one"
params.push = { speed = 3, heading_deg = [-5, 5] }
[presets.other]
based_on = "mine"
params.target = { shapes = "cone", scale = [0.2, 0.2, [0.4, 0.5]] }
"""


def test_user_preset_file(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text(GOOD)
    other = get_preset("collide", f"{file}:other").params
    assert other.push.speed == (3.0, 3.0) and other.push.heading_deg == (-5.0, 5.0)
    assert other.target.shapes == ("cone",)
    assert other.target.scale == ((0.2, 0.2), (0.2, 0.2), (0.4, 0.5))
    assert other.length == 2.0 and other.push.height == 0.8
    assert tuple(read_preset_file(file)) == ("mine", "other")
    with pytest.raises(BadInputError, match=r"\['mine', 'other'\]; choose one as .*own\.toml:NAME"):
        get_preset("collide", str(file))
    with pytest.raises(UnknownNameError, match="closest: other"):
        get_preset("collide", f"{file}:othr")
    with pytest.raises(BadInputError, match="has presets of collide, not of drop"):
        get_preset("drop", f"{file}:mine")
    with pytest.raises(UnknownNameError, match="closest: yeet_box"):
        get_preset("collide", "yeet_bx")


def test_user_presets_may_be_based_on_presets_of_the_scenario() -> None:
    text = """
    scenario = "collide"
    shared.room = "empty"
    [presets.tilted]
    based_on = "yeet_box"
    params.push.heading_deg = 3
    [presets.default]
    based_on = "default"
    params.length = 3
    [presets.far]
    based_on = "default"
    """
    own, known = parse_presets(text, "own.toml"), load_presets("collide")
    base = known["yeet_box"].params
    assert own["tilted"].params == dataclasses.replace(
        base, room="empty", push=dataclasses.replace(base.push, heading_deg=(3.0, 3.0))
    )
    assert own["tilted"].official is None and own["tilted"].published is None
    assert own["far"].params.length == 3, "that of the file comes first"
    assert own["far"].params == dataclasses.replace(
        known["default"].params, length=3.0, room="empty"
    )


PARAMS = 'scenario = "collide"\n[presets.mine.params]\n'
OTHER = 'scenario = "collide"\n[presets.mine]\n'
BAD = {
    "unknown key": (
        PARAMS + "pushh = 3",
        "preset 'mine': unknown key 'pushh'; did you mean 'pu",
    ),
    "unknown nested key": (PARAMS + "push.sped = 3", "preset 'mine': push: unknown key 'sped'"),
    "wrong unit": (
        PARAMS + "push.heading_deg = [-400, 400]",
        "preset 'mine': push: heading_deg is -400, allowed is -360 to 360 degrees",
    ),
    "a unit in the value": (PARAMS + 'length = "2 m"', "length must be a number in m (0 to 50 m)"),
    "beyond the limits": (PARAMS + "probe.mass = 0", "mass is 0, allowed is 0.001 to 10000 kg"),
    "vanishing": (PARAMS + "probe.scale = [0, 1]", "scale is 0, allowed is 0.005 to 200 m"),
    "infinite": (PARAMS + "length = inf", "length must be a finite number, not inf"),
    "not a number": (PARAMS + "length = nan", "length must be a finite number, not nan"),
    "far too large": (PARAMS + f"length = 1{'0' * 400}", "length is 10000000000000000000, allowed"),
    "beyond all digits": (PARAMS + f"length = 1{'0' * 5000}", "is not TOML: "),
    "nested too deep": (PARAMS + f"length = {'[' * 5000}", "is not TOML: "),
    "list of lists": (PARAMS + 'target.shapes = [["cube"]]', "unknown shape "),
    "backwards": (PARAMS + "push.speed = [5, 3]", "speed must go from smaller to larger"),
    "three for two": (PARAMS + "push.speed = [1, 2, 3]", "speed must be a number or [smallest, "),
    "half a preset": (PARAMS + "scenery.occluders = 1.5", "occluders must be a whole number"),
    "truth for number": (PARAMS + "length = true", "length must be a number in m"),
    "number for truth": (PARAMS + "monochrome = 1", "monochrome must be true or false, not 1"),
    "value for table": (PARAMS + "push = 3", "push must be a table of speed, heading_deg"),
    "unknown shape": (
        PARAMS + 'target.shapes = "cub"',
        "shapes: unknown shape 'cub'; closest: ",
    ),
    "no shape": (PARAMS + "target.shapes = []", "shapes must name a shape"),
    "unknown material": (
        PARAMS + 'zone.textures = ["wod"]',
        "unknown material 'wod'; closest: ",
    ),
    "unknown prop": (
        PARAMS + 'scenery.occluder_props = ["vaze"]',
        "unknown prop 'vaze'; closest",
    ),
    "unknown room": (PARAMS + 'room = "boxx"', "room: unknown room 'boxx'; closest: box"),
    "unknown base": (
        OTHER + 'based_on = "theirs"',
        "preset 'mine': based_on 'theirs' is neither before it in",
    ),
    "base is no name": (OTHER + "based_on = [1]", "presets.mine.based_on must be a text, not [1]"),
    "base comes later": (
        OTHER + 'based_on = "later"\n[presets.later]',
        "preset 'mine': based_on 'later' is neither before it in",
    ),
    "base of another scenario": (
        OTHER + 'based_on = "sizes_box"',  # of drop
        "nor among the presets of collide",
    ),
    "static below dynamic": (
        PARAMS + "target = { static_friction = 0.1, dynamic_friction = 0.9 }",
        "preset 'mine': target: static_friction is at most 0.1 and dynamic_friction at least 0.9",
    ),
    "pushed after the end": (
        PARAMS + "push.frame = [0, 151]",
        "preset 'mine': push: frame is 151, allowed is 0 to 150 frames",
    ),
    "unknown property": (
        OTHER + "param = {}",
        "presets.mine: unknown key 'param'; did you mean 'params'? known: about",
    ),
    "bad about": (OTHER + "about = 3", "presets.mine.about must be a text, not 3"),
    "bad published": (
        OTHER + 'published = { trials = "a", contact = 0, frames = 151 }',
        "presets.mine.published.trials must be a whole number, not 'a'",
    ),
    "half published": (
        OTHER + "published = { trials = 3 }",
        "presets.mine.published: missing 'contact', 'frames'",
    ),
    "published is no table": (
        OTHER + "published = 3",
        "presets.mine.published must be an object, not 3",
    ),
    "preset is no table": (
        'scenario = "collide"\npresets.mine = 3',
        "presets.mine must be an object, not 3",
    ),
    "shared": (
        'scenario = "collide"\nshared.lenth = 3',
        "shared: unknown key 'lenth'; did you",
    ),
    "no scenario": ("[presets.mine]", "missing 'scenario'"),
    "unknown file key": (
        'scenario = "collide"\n[preset.mine]',
        "unknown key 'preset'; did you mean 'presets'? known: ",
    ),
    "not TOML": ("scenario = collide", "is not TOML: "),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_named_with_key_and_limits(case: str, tmp_path: Path) -> None:
    text, said = BAD[case]
    file = tmp_path / "own.toml"
    file.write_text(text)
    with pytest.raises(BadInputError) as error:
        read_preset_file(file)
    assert said in str(error.value)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"nowhere\.toml cannot be read"):
        get_preset("collide", str(tmp_path / "nowhere.toml"))
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadInputError, match=r"bytes\.toml cannot be read"):
        read_preset_file(tmp_path / "bytes.toml")
    with pytest.raises(UnknownNameError, match="closest: collide"):
        parse_presets('scenario = "collid"', "own.toml")
    with pytest.raises(UnknownNameError, match="closest: dominoes"):
        load_presets("domino")


def test_parameters_of_another_scenario_are_refused() -> None:
    drop, seed = scenarios.get("drop").params(), trial_seed("test", "drop", "train", 0)
    with pytest.raises(
        BadInputError, match=r"'collide' takes .*collide\.CollideParameters, not DropParameters"
    ):
        sample_scene("collide", seed, drop)


def test_a_number_gives_the_same_scene_and_another_gives_another() -> None:
    first = physion.sample_scene("collide", 3)
    assert physion.sample_scene("collide", 3) == first != physion.sample_scene("collide", 4)
    assert physion.sample_scene("collide", named_seed("scene", "collide", 3)) == first
    assert physion.sample_scene("collide") == physion.sample_scene("collide", 0)


def test_a_preset_stands_for_its_parameters() -> None:
    name = "familiarization"
    scene = physion.sample_scene("collide", 1, preset=name)
    assert scene == physion.sample_scene("collide", 1, get_preset("collide", name).params)
    assert scene != physion.sample_scene("collide", 1)
    with pytest.raises(BadInputError, match="a preset, not both"):
        physion.sample_scene("collide", 1, scenarios.get("collide").params(), preset=name)
    with pytest.raises(UnknownNameError, match="closest: familiarization"):
        physion.sample_scene("collide", 1, preset="familiarisation")


def test_an_engine_can_be_named() -> None:
    scene = physion.sample_scene("collide", 1)
    own = physion.simulate(scene, frames=5)
    assert own.engine.startswith("physion-")
    assert physion.simulate(scene, frames=5, engine="mujoco").engine.startswith("mujoco-")
    with pytest.raises(UnknownNameError, match="unknown engine 'bullet'"):
        physion.simulate(scene, engine="bullet")
