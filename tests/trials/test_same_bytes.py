"""Equal seeds give equal bytes on other processors, code paths, threads, in other environments."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from physion.core.version import golden_digests
from physion.scenes.sampling.build import scenarios
from physion.trials.making.reproduce import trial_digests

PROBE = """
import hashlib, json, locale, math, time
import numba, numpy, scipy.linalg, threadpoolctl
from numba.core.registry import cpu_target
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
pools = [pool for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"]
values = [f(0.001 + 0.0004 * i) for f in (math.sin, math.exp, math.log) for i in range(20000)]
print(json.dumps({
    "blas": [pool.get("architecture", pool["internal_api"]) for pool in pools],
    "threads": [numba.get_num_threads(), *(pool["num_threads"] for pool in pools)],
    "numba": list(cpu_target.target_context.codegen().magic_tuple()[1:]),
    "numpy": [name for name in __cpu_dispatch__ if __cpu_features__[name]],
    "hash": hash("physion"),
    "zone": [time.localtime(0).tm_gmtoff, locale.setlocale(locale.LC_ALL, "")],
    "libm": hashlib.sha256(repr(values).encode()).hexdigest(),
}))
"""
"""Prints the code paths that the libraries of the process have chosen."""
FEATURES = np._core._multiarray_umath.__cpu_features__  # type: ignore[attr-defined]
DISPATCHED = np._core._multiarray_umath.__cpu_dispatch__  # type: ignore[attr-defined]
WITHOUT_AVX512 = tuple(name for name in DISPATCHED if "AVX512" in name or name == "X86_V4")
WITHOUT_AVX2 = (*WITHOUT_AVX512, *(name for name in DISPATCHED if name in ("X86_V3", "AVX2")))


@dataclass(frozen=True)
class Environment:
    """Environment variables that choose code paths of libraries.

    Parameters
    ----------
    settings
        The variables.
    effective
        Whether a result of `PROBE` shows that they took effect; the second argument is the result
        without them.
    needs
        Features of the processor, by numpy's names, without which they cannot take effect.
    """

    settings: dict[str, str]
    effective: Callable[[dict[str, Any], dict[str, Any]], bool]
    needs: tuple[str, ...] = ()


def _blas(core: str, *names: str, needs: tuple[str, ...] = ()) -> Environment:
    """Return the environment with OpenBLAS's kernels for ``core``, reported as one of ``names``."""
    return Environment(
        {"OPENBLAS_CORETYPE": core},
        lambda seen, _: bool(seen["blas"]) and set(seen["blas"]) <= set(names),
        needs,
    )


def _without(names: tuple[str, ...]) -> Environment:
    """Return the environment in which numpy does not use the features ``names``."""
    here = tuple(name for name in names if FEATURES.get(name))
    return Environment(
        {"NPY_DISABLE_CPU_FEATURES": " ".join(here)},
        lambda seen, default: (
            not set(names) & set(seen["numpy"]) and seen["numpy"] != default["numpy"]
        ),
        needs=names[:1],
    )


def _threads(count: int) -> Environment:
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    return Environment(
        dict.fromkeys(names, str(count)), lambda seen, _: set(seen["threads"]) == {count}
    )


ENVIRONMENTS = {
    # Where OpenBLAS is built without kernels for older processors, Prescott's go by Katmai's name.
    # The builds in the wheels of numpy and scipy have no kernels for Zen.
    "blas of prescott": _blas("Prescott", "Prescott", "Katmai"),
    "blas of haswell": _blas("Haswell", "Haswell", needs=("AVX2", "FMA3")),
    "blas of skylake": _blas("SkylakeX", "SkylakeX", needs=("AVX512F",)),
    "generic processor for numba": Environment(
        {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
        lambda seen, _: seen["numba"] == ["generic", ""],
    ),
    "numpy without AVX-512": _without(WITHOUT_AVX512),
    "numpy without AVX2": _without(WITHOUT_AVX2[::-1]),
    "C library without FMA": Environment(
        {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2,-AVX2_Usable,-FMA_Usable"},
        lambda seen, default: seen["libm"] != default["libm"],
        needs=("FMA3",),
    ),
    "one thread": _threads(1),
    "hash seed, time zone and locale": Environment(
        {"PYTHONHASHSEED": "7", "TZ": "<+1245>-12:45", "LC_ALL": "C"},
        lambda seen, default: seen["zone"] == [45_900, "C"] and seen["hash"] != default["hash"],
    ),
    "two threads": _threads(2),
}

TOGETHER = (
    ("blas of prescott", "numpy without AVX2", "C library without FMA", "two threads"),
    ("blas of haswell", "numpy without AVX-512", "one thread", "hash seed, time zone and locale"),
    ("blas of skylake",),
    ("generic processor for numba",),
)
"""Environments whose settings are made together: bytes that none of them changes are equal."""


def run_in(settings: dict[str, str], *command: str) -> str:
    """Run Python in an environment without other choices of code paths; return what it prints."""
    chosen = {name for environment in ENVIRONMENTS.values() for name in environment.settings}
    kept = {name: value for name, value in os.environ.items() if name not in chosen}
    process = subprocess.run(
        [sys.executable, "-W", "ignore", *command],
        env={**kept, **settings},
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    return process.stdout


@cache
def default_code_paths() -> dict[str, Any]:
    return dict(json.loads(run_in({}, "-c", PROBE)))


def lacking(name: str) -> str:
    """Return what this machine lacks for an environment; empty if nothing."""
    if name.startswith("two") and (os.cpu_count() or 1) < 2:
        return "a second core"
    return ", ".join(need for need in ENVIRONMENTS[name].needs if not FEATURES.get(need))


def effective_settings(names: Sequence[str]) -> dict[str, str]:
    """Return the settings of environments after checking that each of them takes effect.

    Left out are those for which the processor lacks what they choose or switch off. If it lacks
    something for all of them, the test is skipped. Elsewhere, settings without effect are a
    failure.
    """
    possible = [ENVIRONMENTS[name] for name in names if not lacking(name)]
    if not possible:
        pytest.skip(f"this machine lacks {'; '.join(lacking(name) for name in names)}")
    settings = {key: value for each in possible for key, value in each.settings.items()}
    seen = json.loads(run_in(settings, "-c", PROBE))
    assert all(each.effective(seen, default_code_paths()) for each in possible), seen
    return settings


@pytest.mark.parametrize("scenario", sorted(scenarios.names()))
def test_trials_match_this_version(scenario: str) -> None:
    """Raise the engine's version with a change that moves a scene: see `reproduce`."""
    assert trial_digests(scenario) == golden_digests()[scenario]


def test_every_environment_is_tested() -> None:
    assert sorted(name for names in TOGETHER for name in names) == sorted(ENVIRONMENTS)


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        # For a generic processor all kernels are compiled, which takes minutes.
        pytest.param(names, marks=() if "one thread" in names else pytest.mark.nightly)
        for names in TOGETHER
    ],
    ids=" + ".join,
)
def test_other_processors_give_the_same_bytes(names: tuple[str, ...]) -> None:
    """The effect of the settings is checked first: ignored ones would prove nothing."""
    several = ("collide", "contain", "drape", "roll")
    printed = run_in(effective_settings(names), "-m", "physion.trials.making.reproduce", *several)
    assert json.loads(printed) == {name: golden_digests()[name] for name in several}


def test_movies_do_not_depend_on_the_processor(tmp_path: Path) -> None:
    """The converter of colours without any SIMD, and x264 without assembler, write the same."""
    code = """
import ctypes, glob, hashlib, sys
from pathlib import Path
import av, av.logging, numpy as np
plain = sys.argv[1] == "plain"
if plain:
    folder = Path(av.__file__).parent.parent / "av.libs"
    (library,) = glob.glob(str(folder / "libavutil*"))
    flags = ctypes.CDLL(library)
    flags.av_force_cpu_flags(0)
    assert flags.av_get_cpu_flags() == 0
from physion.trials import video
if plain:
    video.X264 += ":asm=0"
rng = np.random.default_rng(0)
frames = rng.integers(0, 256, (10, 32, 40, 3)).repeat(6, 1).repeat(6, 2).astype(np.uint8)
av.logging.set_level(av.logging.INFO)
with av.logging.Capture(False) as messages:
    movie = video.encode_movie(frames)
(capabilities,) = [text for *_, text in messages if "cpu capabilities" in text]
assert ("none!" in capabilities) == plain, capabilities
Path(sys.argv[2]).write_bytes(movie)
read = [video.read_frames(Path(sys.argv[2]), size=size) for size in (None, (24, 40))]
print(hashlib.sha256(movie + b"".join(r.tobytes() for r in read)).hexdigest())
"""
    printed = {
        subprocess.run(
            [sys.executable, "-c", code, how, str(tmp_path / how)], stdout=-1, check=True
        ).stdout
        for how in ("quick", "plain")
    }
    assert len(printed) == 1
