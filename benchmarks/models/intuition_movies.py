"""Show the stimuli on which a model that never simulates and noisy simulation differ most.

    python benchmarks/models/intuition_movies.py FOLDER PREDICTIONS.csv OUT [--each 4] [--write]

FOLDER is the one of `intuition.py`, run with ``--many 200``: its simulations are taken. PREDICTIONS
is a table of `physion evaluate`, of one model on the official stimuli. From stimuli without a
contact in the observed part, which end with our engine as recorded, the ones with the largest
difference of P(contact) are drawn: ``--each`` on which people are nearer to the model, at most one
per scenario, and as many on which they are nearer to simulation. OUT gets a movie of each, up to
the end of the trial as our engine simulates it. --write writes the table, and a picture with frames
0, 22 and 44 and the last one, to ``results/intuition_movies``.
"""

from __future__ import annotations

import argparse
import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from intuition_trials import ended_as_recorded, load, predicted, simulated
from physion.analysis.tables import read_humans
from physion.clips.batch import LAST_OBSERVED
from physion.core.names import RIGID
from physion.core.tables import markdown_table
from physion.data.official import official
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.rendering.renderer import Renderer
from physion.scenes.looks import with_role_colors
from physion.scenes.scene import Scene
from physion.trials.video import encode_movie

RESULTS = Path(__file__).parents[1] / "results" / "intuition_movies.md"
SAMPLES, SIZE, SHOWN = 200, 256, 160
MOST = 100
"""Stimuli with the largest differences, about which the page says to what people are nearer."""
SHOWN_FRAMES = (0, LAST_OBSERVED // 2, LAST_OBSERVED)


def differing(folder: Path, predictions: Path) -> pd.DataFrame:
    """Return stimuli with all answers and outcomes; the largest difference comes first."""
    made = load(folder / "official", [])
    facts = pd.DataFrame({n: made[n] for n in ("scenario", "contact", "scene")}, made["trial"])
    facts = facts[~made["observed_contact"] & facts["scenario"].isin(RIGID)]
    people = read_humans(official().humans).set_index("stimulus")
    facts = facts[facts.index.isin(people.index)]
    (answers,) = predicted(predictions).values()
    facts["model"] = answers.reindex(facts.index)
    facts = facts.dropna(subset="model")
    facts["as_recorded"] = ended_as_recorded(predictions)[facts.index]
    facts["simulation"] = simulated(folder, facts["scene"].to_dict(), 1.0, SAMPLES)
    accuracy = people["accuracy"].reindex(facts.index).astype(float)
    facts["people"] = accuracy.where(facts["contact"].astype(bool), 1 - accuracy)
    apart = [(facts["people"] - facts[name]).abs() for name in ("model", "simulation")]
    facts["nearer"] = np.where(apart[0] < apart[1], "model", "simulation")
    gap = (facts["model"] - facts["simulation"]).abs()
    return facts.loc[gap.sort_values(ascending=False, kind="stable").index]


def chosen(table: pd.DataFrame, each: int) -> pd.DataFrame:
    """Return the first stimuli of each kind that end as recorded, at most one per scenario."""
    first = table[table["as_recorded"]].drop_duplicates(["nearer", "scenario"])
    return pd.concat(part.head(each) for _, part in first.groupby("nearer"))


def drawn(scene: Scene) -> tuple[NDArray[np.uint8], bool]:
    """Return all frames (T, H, W, 3) of a trial, and whether agent and patient touch there."""
    path = simulate(scene)
    renderer = Renderer(with_role_colors(scene), path, SIZE, SIZE)
    frames: Any = [renderer.render(frame, ("color",)).color for frame in range(len(path))]
    return np.stack(frames), bool(label_contact(scene, path).contact)


def main() -> None:
    """Draw the stimuli, and print their answers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("predictions", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--each", type=int, default=4)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    strips: list[NDArray[np.uint8]] = []
    rows: list[list[object]] = []
    every = differing(options.folder, options.predictions)
    first = every.head(MOST)
    table = chosen(every, options.each)
    for name, row in table.iterrows():
        pictures, contact = drawn(Scene.from_json(row["scene"]))
        (options.out / f"{name}.mp4").write_bytes(encode_movie(pictures))
        some = [Image.fromarray(pictures[frame]) for frame in (*SHOWN_FRAMES, -1)]
        small = [np.asarray(one.resize((SHOWN, SHOWN))) for one in some]
        strips.append(np.concatenate(small, axis=1))
        answers = [f"{row[column]:.2f}" for column in ("people", "model", "simulation")]
        ends = ["contact" if touches else "no contact" for touches in (row["contact"], contact)]
        rows.append([len(rows) + 1, str(name), row["scenario"], *ends, *answers, row["nearer"]])
        print(*rows[-1], flush=True)
    heads = ("row", "stimulus", "scenario", "recorded", "our engine", "people", "model")
    nearer = [
        f"on {(part['nearer'] == 'model').sum()} of {len(part)}"
        for part in (first, first[first["as_recorded"]], every, every[every["as_recorded"]])
    ]
    text = markdown_table([*heads, "simulation", "people are nearer to"], rows)
    half = -(-len(strips) // 2)
    strips += [np.full_like(strips[0], 255)] * (2 * half - len(strips))
    columns = [np.concatenate(strips[:half]), np.concatenate(strips[half:])]
    picture = Image.fromarray(np.concatenate(columns, axis=1)).quantize(256)
    if options.write:
        picture.save(RESULTS.with_suffix(".png"), optimize=True)
        RESULTS.write_text(
            "# Stimuli on which intuition and simulation differ most\n\n"
            f"`python benchmarks/models/intuition_movies.py FOLDER {options.predictions.name} OUT "
            f"--write`, {datetime.date.today()}. Answers are P(contact), from {SAMPLES} "
            "simulations, from the model, and as the fraction of people who say yes.\n\n"
            f"People are nearer to the model {nearer[0]} stimuli that differ most, {nearer[1]} of "
            f"these that end with our engine as recorded; {nearer[2]} of all, and {nearer[3]} of "
            f"all that end as recorded.\n\n{text}\n\n"
            "Frames 0, 22, 44 and the last one, by our engine, of each, down the left column and "
            "then the right one:\n\n![stimuli](intuition_movies.png)\n"
        )


if __name__ == "__main__":
    main()
