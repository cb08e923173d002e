"""Check this machine: versions, cores, memory, GPU, codecs, write access; print what to install.

With --bench, measure it instead: simulation, rendering and making of trials of each scenario, in
time of the processor, on one core.
"""

from __future__ import annotations

import importlib.metadata
import json as json_module
import os
import platform
import re
import shutil
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

from physion.cli.output import print_line
from physion.compute.local import available_cores
from physion.core.errors import BadInputError
from physion.core.version import __version__

DISTRIBUTION = "physion-benchmark"


@dataclass(frozen=True)
class Options:
    """Options of ``physion doctor``."""

    folder: Path = Path()
    """Folder whose write access is checked."""
    reproduce: bool = False
    """Also generate a known trial of each scenario and compare it with its known digests."""
    bench: bool = False
    """Measure the machine in place of the checks; takes some minutes."""
    scenario: str = "all"
    """With --bench: name of a scenario, or all."""
    count: int = 2
    """With --bench: official scenes and trials of each scenario."""
    json: bool = False
    """Print one JSON object instead of lines."""


@dataclass(frozen=True)
class Check:
    """Result of one check; ``remedy`` is a command or advice, empty where nothing is wrong."""

    name: str
    value: str
    good: bool = True
    needed: bool = True
    remedy: str = ""


def main(options: Options) -> int:
    """Print the checks; return 1 if a requirement of the core is missing."""
    if options.bench:
        if options.reproduce:
            raise BadInputError("--bench and --reproduce are two things: give one of them")
        # Imported late: loading the compiled renderer takes time.
        from physion.cli.bench import print_bench

        print_bench(options.scenario, options.count, options.json)
        return 0
    if (options.scenario, options.count) != (Options.scenario, Options.count):
        raise BadInputError("--scenario and --count belong to --bench: add it")
    checks = [*machine(), *packages(), gpu(), codec(), writable(options.folder)]
    if options.reproduce:
        checks += reproduction()
    if options.json:
        print(json_module.dumps([asdict(check) for check in checks], indent=1))
    else:
        for check in checks:
            mark = "ok     " if check.good else "MISSING" if check.needed else "absent "
            remedy = f"   -> {check.remedy}" if check.remedy else ""
            print_line(f"{mark} {check.name:<18} {check.value}{remedy}")
    return 1 if any(check.needed and not check.good for check in checks) else 0


def machine() -> list[Check]:
    """Check Python, processor cores and memory."""
    pages = os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    gigabytes = pages * os.sysconf("SC_PAGE_SIZE") / 2**30 if pages else float("nan")
    version = platform.python_version()
    fresh = tuple(map(int, version.split(".")[:2])) >= (3, 11)
    return [
        Check("physion", __version__),
        Check("python", version, fresh, remedy="" if fresh else "install Python 3.11 or newer"),
        Check("system", platform.platform()),
        Check("cores", str(available_cores())),
        Check("memory", f"{gigabytes:.1f} GiB"),
    ]


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def requirements() -> dict[str, list[str]]:
    """Return the packages that each extra needs; packages of the core have the name ``""``."""
    found: dict[str, list[str]] = {"": []}
    for line in importlib.metadata.requires(DISTRIBUTION) or ():
        needed, _, condition = line.partition(";")
        package = re.split(r"[^A-Za-z0-9._-]", needed.strip())[0]
        extra = re.search(r"extra == ['\"](.+?)['\"]", condition)
        if package != DISTRIBUTION:  # the extra "all" names the others
            found.setdefault(extra[1] if extra else "", []).append(package)
    return found


def packages() -> list[Check]:
    """Check what the package needs, and its extras; the remedy is the command that installs it."""
    try:
        needed = requirements()
    except importlib.metadata.PackageNotFoundError:
        remedy = "in the clone: pip install -e . -c requirements.lock"
        return [Check(DISTRIBUTION, "not installed", False, remedy=remedy)]
    checks = []
    for package in needed.pop(""):
        version = _version(package)
        remedy = "" if version else f"pip install {package}"
        checks.append(Check(package, version or "not installed", bool(version), remedy=remedy))
    for extra, names in needed.items():
        missing = [name for name in names if _version(name) is None]
        value = ", ".join(f"{name} {_version(name)}" for name in names)
        if missing:
            value = f"without {', '.join(missing)}"
        remedy = (
            f"in the clone: pip install -e '.[{extra}]' -c requirements.lock" if missing else ""
        )
        checks.append(Check(f"extra {extra}", value, not missing, needed=False, remedy=remedy))
    return checks


def gpu() -> Check:
    """Check which accelerator torch finds."""
    if _version("torch") is None:
        return Check("gpu", "unknown without torch", False, needed=False)
    import torch

    if torch.cuda.is_available():
        return Check("gpu", torch.cuda.get_device_name(0))
    return Check("gpu", "none: everything runs on the processor", False, needed=False)


def codec() -> Check:
    """Check whether movies can be written and read."""
    try:
        import av

        av.codec.Codec("libx264", "w")
        av.codec.Codec("h264", "r")
    except Exception as error:  # PyAV has exceptions of its own, and ImportError without FFmpeg
        return Check("codec", f"H.264: {error}", False, remedy="pip install --force-reinstall av")
    return Check("codec", f"H.264 through PyAV {av.__version__}")


def reproduction() -> list[Check]:
    """Check whether trials generated here have the digests of this version."""
    from physion.core.version import golden_digests
    from physion.trials.making.reproduce import differences

    checks = []
    for scenario in sorted(golden_digests()):
        parts = differences(scenario)
        value = f"different: {', '.join(parts)}" if parts else "as expected"
        remedy = "install the versions of requirements.lock" if parts else ""
        checks.append(Check(f"bytes of {scenario}", value, not parts, remedy=remedy))
    return checks


def writable(folder: Path) -> Check:
    """Check whether ``folder`` can be written to, and its free space."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            pass
        free = shutil.disk_usage(folder).free / 2**30
    except OSError as error:
        remedy = "choose another folder with --folder"
        return Check("write access", f"{folder}: {error.strerror}", False, remedy=remedy)
    return Check("write access", f"{folder.resolve()}, {free:.0f} GiB free")
