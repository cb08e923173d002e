"""Export of what a model that generates movies is given: pictures, movies, a prompt, a card.

A folder holds ``conditioning.csv`` (one row per trial), ``images/`` (the last observed frame),
``movies/`` (the observed part), ``README.md`` and ``card.json``, which the user fills in. Nothing
in it tells an outcome. `physion.judging` reads what comes back.
"""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

from physion.compute.tasks import Progress, tracked
from physion.core.files import folder_for_writing, remove_leftovers, write_atomic
from physion.trials.dataset import Dataset
from physion.trials.files import encode_png
from physion.trials.share.items import frames_of, items_of, movie_of

PROTOCOL = "physion-judge-1"
"""Name of the rules of what is generated and how it is judged; a change gets a new name."""
SEEDS = 4
"""Movies of each trial, of seeds that differ."""
PROMPT = (
    "The camera does not move. The objects move on by the laws of physics until they are at rest."
)
_README = """\
# Movies to generate: {count} trials, {seeds} seeds
1. `conditioning.csv` lists the trials. `image` is the last observed frame, number {last} from 0;
   `movie` is the whole observed part, frames 0 to {last} at {rate:g} a second. The last k
   frames are the last k of `movie`. Give your model one of these, and `prompt`.
2. Generate {seeds} movies of each trial, with seeds that differ, of at least `frames` frames of
   `width` x `height` pixels at `rate` a second. The first new frame is number {first}. Another size
   of the same shape and another rate are allowed; a movie must last as long.
3. Put them into `FOLDER/SEED/TRIAL.mp4`, and `card.json`, filled in, into FOLDER. `first_frame`
   is the number of the frame of the trial that your movies begin with: {first} if they hold new
   frames only, {last} if they begin with the image, 0 if they begin with the whole movie.
4. `physion judge FOLDER {dataset}` measures them and writes a page.
"""


def export_conditioning(
    folder: Path,
    out: Path,
    *,
    split: str | None = None,
    scenario: str | None = None,
    verify: bool = True,
    progress: Progress | None = None,
) -> list[Path]:
    """Write what movies are generated from into ``out``; return README, list and card.

    Parameters
    ----------
    folder, out
        Folder of the dataset, and folder to write into. Trials without movies in red and yellow are
        rendered.
    split, scenario
        Trials; by default all of the split testing.
    verify
        Compare movies with their SHA-256 in the index.
    progress
        Called after every trial.

    Raises
    ------
    UnknownNameError
        For an unknown split or scenario.
    BadInputError
        For a trial without a label.
    """
    dataset = Dataset(folder, verify=verify)
    items = items_of(dataset, split=split or "testing", scenario=scenario)[::2]
    index = dataset.index.set_index("trial")
    # Trials end when all is at rest: one length for a scenario says nothing of a trial.
    longest = index.loc[[item.trial for item in items]].groupby("scenario")["frames"].max()
    rows, first, rate = [], 0, 0.0
    with folder_for_writing(out):
        remove_leftovers(out)
        for name in ("images", "movies"):
            (out / name).mkdir(exist_ok=True)
        for item in tracked(items, "trials", len(items), progress):
            facts = index.loc[item.trial]
            first, rate = int(facts["observed_frames"]), facts["frames"] / facts["playback_seconds"]
            row = {
                "trial": item.trial,
                "image": f"images/{item.trial}.png",
                "movie": f"movies/{item.trial}.mp4",
                "prompt": PROMPT,
                "width": facts["width"],
                "height": facts["height"],
                "rate": f"{rate:g}",
                "first_frame": first,
                "frames": longest[item.scenario] - first,
            }
            write_atomic(out / row["movie"], movie_of(dataset, item))
            write_atomic(out / row["image"], encode_png(frames_of(dataset, item)[-1]))
            rows.append(row)
        table = io.StringIO()
        writer = csv.DictWriter(table, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        card = {
            "protocol": PROTOCOL,
            "model": "",
            "conditioning": "last frame",
            "prompt": PROMPT,
            "first_frame": first,
            "seeds": [str(seed) for seed in range(SEEDS)],
        }
        readme = _README.format(
            count=len(items), seeds=SEEDS, last=first - 1, first=first, rate=rate,
            dataset=folder.resolve().name,
        )  # fmt: skip
        texts = {
            "README.md": readme,
            "conditioning.csv": table.getvalue(),
            "card.json": json.dumps(card, indent=1) + "\n",
        }
        for name, text in texts.items():
            write_atomic(out / name, text.encode())
    return [out / name for name in texts]
