"""Entry point ``physion VERB ...``: imports the module of the verb and prints errors in one line.

Exit codes: 0 done; 1 done, but some trials failed or a check found a fault; 2 bad input or usage,
no file is left half-written; 130 interrupted, the same command resumes.
"""

from __future__ import annotations

import importlib
import sys

VERBS = {
    "run": "run the whole pipeline: scenes, trials, models, readout, comparison, report",
    "generate": "sample scenes and write trials",
    "replay": "simulate official command logs and compare with the recorded outcomes",
    "evaluate": "train models and readouts on trials and write their predictions",
    "compare": "compare predictions with people",
    "experiment": "run the experiment with people: init, serve, export",
    "view": "write a page that shows a dataset: movies, passes, motion in 3D",
    "export": "write the official layout, webdataset shards, or a dataset card",
    "import": "convert official HDF5 files and movies to trials",
    "verify": "check every byte, label and motion of a dataset",
    "ls": "list scenarios, presets, shapes, props, materials, models, engines",
    "doctor": "check this machine and print what to install",
}

MODULES = {
    "import": "import_trials",
    "compare": "compare.compare",
    "experiment": "experiment.experiment",
}
"""Modules of verbs that are Python keywords or have sub-verbs."""


def _usage() -> str:
    verbs = "\n".join(f"  {name:<10} {text}" for name, text in VERBS.items())
    return (
        "usage: physion VERB [options]     (physion VERB --help lists them)\n\n"
        f"{verbs}\n\n"
        "exit codes: 0 done, 1 done with failures, 2 bad input, 130 interrupted"
    )


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    args = sys.argv[1:] if argv is None else argv
    if not args or args[0] in ("-h", "--help"):
        print(_usage())
        return 0 if args else 2
    if args[0] == "--version":
        from physion import __version__

        print(f"physion {__version__}")
        return 0
    from physion.errors import PhysionError, UnknownNameError

    try:
        if args[0] not in VERBS:
            raise UnknownNameError("verb", args[0], VERBS)
        import tyro

        module = importlib.import_module(f"physion.cli.{MODULES.get(args[0], args[0])}")
        taken = 1
        if args[1:2] and args[1] in getattr(module, "SUBVERBS", {}):
            module, taken = importlib.import_module(module.SUBVERBS[args[1]]), 2
        options = tyro.cli(
            module.Options,
            args=args[taken:],
            prog=" ".join(["physion", *args[:taken]]),
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
        print("physion: interrupted; run the same command again to resume", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
