"""``physion VERB ...``: finds the verb, imports only what it needs, turns errors into one line.

Exit codes: 0 done; 1 done, but some trials failed or a check found a fault; 2 bad input or usage,
nothing half-written; 130 interrupted, the same command goes on where it stopped.
"""

from __future__ import annotations

import importlib
import sys

VERBS = {
    "run": "the whole road: scenes, trials, models, readout, comparison, report",
    "generate": "sample scenes and write trials",
    "replay": "simulate official command logs and compare with the recorded outcomes",
    "evaluate": "train models and readouts on trials and write their predictions",
    "compare": "compare predictions with people",
    "experiment": "run the experiment with people: init, serve, export",
    "view": "one page of a dataset: movies, passes, motion to turn by hand",
    "export": "write the official layout, webdataset shards, or a dataset card",
    "import": "read official HDF5 and movie folders into trials",
    "verify": "check every byte, label and motion of a dataset",
    "ls": "list scenarios, presets and their values, props, materials, models",
    "doctor": "check this machine and say what to install",
}

MODULES = {
    "import": "import_trials",
    "compare": "compare.compare",
    "experiment": "experiment.experiment",
}
"""Modules of verbs whose names are keywords, or that have verbs of their own."""


def _usage() -> str:
    verbs = "\n".join(f"  {name:<10} {text}" for name, text in VERBS.items())
    return (
        "usage: physion VERB [options]     (physion VERB --help says which)\n\n"
        f"{verbs}\n\n"
        "exit codes: 0 done, 1 done with failures, 2 bad input, 130 interrupted"
    )


def main(argv: list[str] | None = None) -> int:
    """Run one verb; returns the exit code."""
    words = sys.argv[1:] if argv is None else argv
    if not words or words[0] in ("-h", "--help"):
        print(_usage())
        return 0 if words else 2
    if words[0] == "--version":
        from physion import __version__

        print(f"physion {__version__}")
        return 0
    from physion.errors import PhysionError, UnknownNameError

    try:
        if words[0] not in VERBS:
            raise UnknownNameError("verb", words[0], VERBS)
        import tyro

        module = importlib.import_module(f"physion.cli.{MODULES.get(words[0], words[0])}")
        taken = 1
        if words[1:2] and words[1] in getattr(module, "SUBVERBS", {}):
            module, taken = importlib.import_module(module.SUBVERBS[words[1]]), 2
        options = tyro.cli(
            module.Options,
            args=words[taken:],
            prog=" ".join(["physion", *words[:taken]]),
            description=module.__doc__,
        )
        return int(module.main(options))
    except PhysionError as error:
        message = " ".join(str(error).split())
        print(f"physion: {message}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        print(f"physion: {error.filename or 'a file'}: {error.strerror or error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("physion: interrupted; the same command goes on from here", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
