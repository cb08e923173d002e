"""Stand-ins for the commands of Slurm that run jobs on this machine.

As a program it is called by the name of a command (sbatch, srun, sacct, scancel). $FAKE_SLURM has a
file with the state of each job, and one with the number of its group of processes.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from support.paths import FIND_TESTS, ROOT

COMMANDS = ("sbatch", "srun", "sacct", "scancel")


def install(folder: Path, patch: pytest.MonkeyPatch) -> Path:
    """Put the commands on the path; return the folder with the states of the jobs."""
    programs, states = folder / "bin", folder / "states"
    programs.mkdir(parents=True)
    states.mkdir()
    for name in COMMANDS:
        path = programs / name
        path.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{__file__}" {name} "$@"\n')
        path.chmod(0o755)
    patch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    patch.setenv("FAKE_SLURM", str(states))
    patch.setenv("PYTHONPATH", f"{FIND_TESTS['PYTHONPATH']}{os.pathsep}{ROOT / 'src'}")
    return states


def sbatch(script: str) -> None:
    """Start the jobs of an array, or one job, and print their number."""
    states = Path(os.environ["FAKE_SLURM"])
    # submitit remembers the numbers of ended jobs: none may come twice in a process.
    number = str(time.time_ns() // 1000)
    text = Path(script).read_text()
    (states / f"{number}.script").write_text(text)
    array = re.search(r"^#SBATCH --array=0-(\d+)", text, re.M)
    for index in range(int(array[1]) + 1) if array else [None]:
        job = number if index is None else f"{number}_{index}"
        (states / f"{job}.state").write_text("RUNNING")
        values = {"SLURM_JOB_ID": number, "SLURM_NTASKS": "1", "SLURM_PROCID": "0"}
        values |= {"SLURM_LOCALID": "0", "SLURM_NODEID": "0", "SLURM_JOB_NUM_NODES": "1"}
        if index is not None:
            values |= {"SLURM_ARRAY_JOB_ID": number, "SLURM_ARRAY_TASK_ID": str(index)}
        # A shell that notes how the job ended, in a group that scancel can end.
        end = f'bash "{script}"; test $? = 0 && s=COMPLETED || s=FAILED; '
        end += f'echo $s > "{states}/{job}.state"'
        process = subprocess.Popen(
            ["bash", "-c", end],
            env=os.environ | values,
            start_new_session=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        (states / f"{job}.group").write_text(str(process.pid))
    print(f"Submitted batch job {number}")


def srun(*arguments: str) -> None:
    """Run the command, with the output in its files."""
    words = list(arguments)
    files: dict[str, str] = {}
    while words[0].startswith("-"):
        name = words.pop(0)
        if name in ("--output", "--error"):
            files[name] = words.pop(0)
    marks = {"%A": os.environ.get("SLURM_ARRAY_JOB_ID", ""), "%t": "0"}
    marks |= {"%a": os.environ.get("SLURM_ARRAY_TASK_ID", ""), "%j": os.environ["SLURM_JOB_ID"]}
    paths = []
    for name in ("--output", "--error"):
        path = files[name]
        for mark, value in marks.items():
            path = path.replace(mark, value)
        paths.append(path)
    with Path(paths[0]).open("a") as out, Path(paths[1]).open("a") as err:
        done = subprocess.run(words, stdout=out, stderr=err, check=False)
    sys.exit(1 if done.returncode else 0)


def sacct(*arguments: str) -> None:
    """Print the states of all jobs; the numbers that are asked for do not matter."""
    print("JobID|State|NodeList")
    for path in sorted(Path(os.environ["FAKE_SLURM"]).glob("*.state")):
        print(f"{path.stem}|{path.read_text().strip()}|here")


def scancel(job: str) -> None:
    """End a job."""
    states = Path(os.environ["FAKE_SLURM"])
    state = states / f"{job}.state"
    if state.read_text().strip() == "RUNNING":
        state.write_text("CANCELLED")
        os.killpg(int((states / f"{job}.group").read_text()), signal.SIGKILL)


if __name__ == "__main__":
    {"sbatch": sbatch, "srun": srun, "sacct": sacct, "scancel": scancel}[sys.argv[1]](*sys.argv[2:])
