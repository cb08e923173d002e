"""Examples that ``physion VERB --help`` prints below the description."""

from __future__ import annotations

from collections.abc import Sequence

EXAMPLES: dict[str, tuple[str, ...]] = {
    "run": (
        "physion run --limit 4 --models constant-motion,gns",
        "physion run --sampled --limit 2 --out runs/try",
    ),
    "generate": (
        "physion generate trials --scenario collide --split readout --count 20",
        "physion generate trials --split all --full --workers 16",
    ),
    "replay": (
        "physion replay --scenario drop --limit 20",
        "physion replay --engines physion,mujoco --json replay.json",
    ),
    "train": (
        "physion train gns trials --steps 1000",
        "physion train gns,dpi trials --protocols all,all-but,only --seeds 3 --dry-run",
    ),
    "evaluate": (
        "physion evaluate trials gns,constant-motion --out runs/models",
        "physion evaluate trials my_model.py:MyEncoder",
    ),
    "compare": (
        "physion compare runs/models/predictions/*.csv --humans official",
        "physion compare --responses study/export/trials.csv",
    ),
    "compare official": ("physion compare official official --out runs/published",),
    "compare validate": ("physion compare validate predictions.csv --labels labels.csv",),
    "compare power": ("physion compare power --effect 0.1 --people 20 40 --stimuli 60 100",),
    "experiment": ("physion experiment init study --trials trials",),
    "experiment init": (
        "physion experiment init study --trials trials --test 80 --languages en",
        "physion experiment init study --scenes official --scenario drop",
    ),
    "experiment serve": ("physion experiment serve study --port 8080",),
    "experiment links": ("physion experiment links study --source prolific",),
    "experiment simulate": ("physion experiment simulate study --participants 50",),
    "experiment export": ("physion experiment export study --layout psych-ds",),
    "experiment password": ("physion experiment password study",),
    "experiment accounts": ("physion experiment accounts study --add grace --role analyst",),
    "experiment backup": ("physion experiment backup study --out backups",),
    "experiment forget": ("physion experiment forget study --participant 5f0c1e",),
    "view": (
        "physion view trials --scenario collide",
        "physion view trials --predictions gns --option weights=shipped",
    ),
    "export": (
        "physion export trials official-files --layout official",
        "physion export trials --layout card --creator 'A. Author' --license CC-BY-4.0",
    ),
    "import": ("physion import official-files trials --split testing",),
    "import-official": ("physion import-official CHECKOUT study",),
    "verify": (
        "physion verify trials --again 20",
        "physion verify trials --against trials-of-another-machine",
    ),
    "ls": ("physion ls models", "physion ls presets"),
    "doctor": ("physion doctor --reproduce",),
    "bench": ("physion bench", "physion bench --scenario drop --count 10 --json"),
    "completion": ("physion completion bash > ~/.local/share/bash-completion/completions/physion",),
}
"""Command lines by verb, or verb and sub-verb; tests parse each."""


def describe(text: str | None, names: Sequence[str]) -> str:
    """Return the description of a verb, which is ``text``, followed by its examples."""
    examples = EXAMPLES.get(" ".join(names), ())
    lines = "\n".join(f"  {example}" for example in examples)
    return f"{(text or '').strip()}\n\nExamples:\n{lines}" if lines else text or ""
