"""Entry point ``physion VERB ...``: imports the module of the verb and prints errors in one line.

Exit codes: 0 done; 1 done, but some trials failed or a check found a fault; 2 bad input or usage,
no file is left half-written; 130 interrupted, the same command resumes; 141 the program that reads
the output closed it, as ``head`` does.
"""

from __future__ import annotations

import os
import sys

from physion.cli.help import VERBS, describe, find_module, module_of

OUTPUT_CLOSED = 141
"""Exit code that shells show for programs that write to a closed pipe: 128 + SIGPIPE."""


def _usage() -> str:
    verbs = "\n".join(f"  {name:<15} {text}" for name, text in VERBS.items())
    return (
        "usage: physion VERB [options]     (physion VERB --help lists them)\n\n"
        f"{verbs}\n\n"
        "exit codes: 0 done, 1 done with failures, 2 bad input, 130 interrupted,\n"
        "            141 the program that reads the output closed it"
    )


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    from physion.core.errors import MEMORY_SETTINGS, PhysionError, one_line

    try:
        try:
            return _run_verb(sys.argv[1:] if argv is None else argv)
        finally:
            # Otherwise what is buffered would be written, and fail, after the last handler.
            if sys.stdout is not None:
                sys.stdout.flush()
    except PhysionError as error:
        print(f"physion: {one_line(error)}", file=sys.stderr)
        return error.exit_code
    except MemoryError:
        text = f"memory is used up; {MEMORY_SETTINGS}, where the verb has them"
        print(f"physion: {text}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        _discard_output()
        return OUTPUT_CLOSED
    except OSError as error:
        print(f"physion: {one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("physion: interrupted; run the same command again to resume", file=sys.stderr)
        return 130


def _run_verb(args: list[str]) -> int:
    """Print usage or version, or run the verb that ``args`` start with; return the exit code."""
    if not args or args[0] in ("-h", "--help"):
        print(_usage())
        return 0 if args else 2
    if args[0] == "--version":
        from physion.core.version import __version__

        print(f"physion {__version__}")
        return 0
    # Imported late: it takes time.
    from physion.cli.arguments import no_such, read_options

    if args[0] not in VERBS:
        raise no_such("verb", args[0], VERBS, "physion --help")
    module, taken = find_module(args)
    options = read_options(
        module.Options,
        args[taken:],
        " ".join(["physion", *args[:taken]]),
        describe(module.__doc__, args[:taken]),
    )
    if taken == 2:
        module_of(args[0]).require_extra()
    return int(module.main(options))


def _discard_output() -> None:
    """Let standard output lead nowhere, so that what is buffered causes no error at exit."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)


if __name__ == "__main__":
    sys.exit(main())
