"""Equal seeds give equal bytes on other processors, code paths of libraries and threads."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from physion.golden import golden_digests
from physion.scenes.sampling.registry import scenarios
from physion.trials.making.reproduce import trial_digests

AVX512 = (
    "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR "
    "AVX512_KNL AVX512_KNM X86_V4"
)
ENVIRONMENTS = {
    "blas of prescott": {"OPENBLAS_CORETYPE": "Prescott"},
    "blas of haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "blas of zen": {"OPENBLAS_CORETYPE": "Zen"},
    "blas of skylake": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "generic processor for numba": {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
    "numpy without AVX-512": {"NPY_DISABLE_CPU_FEATURES": AVX512},
    "numpy without AVX2": {"NPY_DISABLE_CPU_FEATURES": f"{AVX512} AVX2 FMA3 X86_V3"},
    "C library without FMA": {
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2,-AVX2_Usable,-FMA_Usable"
    },
    "one thread": dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
    ),
    "two threads": dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "2"
    ),
}


@pytest.mark.parametrize("scenario", sorted(scenarios.names()))
def test_trials_are_those_of_this_version(scenario: str) -> None:
    """Raise the engine's version with a change that moves a scene: see `reproduce`."""
    assert trial_digests(scenario) == golden_digests()[scenario]


@pytest.mark.slow
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_other_processors_give_the_same_bytes(name: str) -> None:
    settings = _possible(ENVIRONMENTS[name])
    process = subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "physion.trials.making.reproduce"],
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    assert json.loads(process.stdout) == golden_digests()


def _possible(settings: dict[str, str]) -> dict[str, str]:
    """Leave out features that this build of numpy does not know or this processor lacks."""
    name = "NPY_DISABLE_CPU_FEATURES"
    if name not in settings:
        return settings
    features = np._core._multiarray_umath.__cpu_features__  # type: ignore[attr-defined]
    dispatched = set(np._core._multiarray_umath.__cpu_dispatch__)  # type: ignore[attr-defined]
    known = [f for f in settings[name].split() if features.get(f) and f in dispatched]
    return {name: " ".join(known)} if known else {}


@pytest.mark.slow
def test_the_environments_do_change_what_libraries_compute() -> None:
    """Else the test above could not fail."""
    code = (
        "import numpy as np, hashlib;"
        "rng = np.random.default_rng(0); a = rng.normal(size=(200, 200));"
        "print(hashlib.sha256((a @ a).tobytes() + np.exp(a).tobytes()).hexdigest())"
    )
    found = set()
    for settings in ENVIRONMENTS.values():
        env = {**os.environ, **_possible(settings)}
        found.add(
            subprocess.run([sys.executable, "-c", code], env=env, stdout=-1, check=True).stdout
        )
    assert len(found) > 1


def test_movies_do_not_depend_on_the_processor(tmp_path: Path) -> None:
    """The converter of colours without any SIMD, and x264 without assembler, write the same."""
    code = """
import ctypes, glob, hashlib, sys
from pathlib import Path
import av, numpy as np
plain = sys.argv[1] == "plain"
if plain:
    folder = Path(av.__file__).parent.parent / "av.libs"
    (library,) = glob.glob(str(folder / "libavutil*"))
    ctypes.CDLL(library).av_force_cpu_flags(0)
from physion.trials import video
if plain:
    video.X264 += ":asm=0"
rng = np.random.default_rng(0)
frames = rng.integers(0, 256, (10, 32, 40, 3)).repeat(6, 1).repeat(6, 2).astype(np.uint8)
movie = video.encode_movie(frames)
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
