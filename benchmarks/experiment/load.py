"""How many participants one server carries.

    python benchmarks/experiment/load.py [--write]
        [--seconds 180] [--people 200] [--every 6] [--full 20] [--loads paced media full]

A study of 150 test trials is served by `physion experiment serve` in one process; this process
plays the participants with a client made to cost little, on the same cores. Each load runs on a new
database with durable writes, after everybody has gone through consent and familiarization:

- ``paced``: ``people`` participants at once, each posting one answer every ``every`` seconds;
- ``media``: the same, each fetching movie and map before every answer, and an experimenter who
  reloads the overview every 2 s;
- ``full``: every participant posts the next answer as soon as the last one is acknowledged, and
  begins anew as another participant when the trials are through.

After each the server is stopped and every acknowledged answer is looked for in the database: it
must be there once, as it was sent, and nothing else. Times are from sending an answer to having its
acknowledgement. Aims: no error, 99 % acknowledged under 250 ms; at least 400 answers/s.
``--profile FILE`` lets cProfile write the server's profile of the last load.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import platform
import random
import sys
import tempfile
import time
import uuid
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa
import uvloop

from light_http import Connection, request
from physion.compute.tasks import processor
from physion.experiment.server_process import HOST, ServerProcess
from physion.experiment.store.database import ANSWERS, SESSIONS, open_database
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.study import Study

ROOT = Path(__file__).parents[2]
RESULTS = Path(__file__).parents[1] / "results"
sys.path.insert(0, str(ROOT / "tests"))
LOADS = ("paced", "media", "full")
TEST_TRIALS = 150
AIM_P99_MS, AIM_ANSWERS_PER_S = 250, 400
PASSWORD = "tiny password"


@dataclass
class Tally:
    """What happened in a load: acknowledged answers by key, their times, and what went wrong."""

    answers: dict[str, tuple[str, int, str, float]] = field(default_factory=dict)
    """By key: reference of the session, trial, response, rt_ms."""
    seconds: list[float] = field(default_factory=list)
    errors: Counter[str] = field(default_factory=Counter)
    notes: Counter[str] = field(default_factory=Counter)
    """What is no error: connections that the server closed while idle."""
    fetched: int = 0
    fetched_bytes: int = 0
    reload_seconds: list[float] = field(default_factory=list)
    """Of the experimenter's overview."""

    @property
    def failures(self) -> int:
        return self.errors.total()


@dataclass
class Row:
    """One load as it was measured; processor time in cores."""

    name: str
    tally: Tally
    wall_s: float
    p50_ms: float
    p99_ms: float
    slowest_ms: float
    server_cpu: float
    client_cpu: float
    wrong: int = -1


class Participant:
    """One participant with a connection of its own."""

    def __init__(self, number: int, port: int, word: str, tally: Tally) -> None:
        self._connection = Connection(HOST, port)
        self._host, self._word, self._tally = f"{HOST}:{port}", word, tally
        self.close = self._connection.close
        self._number, self._life = number, 0
        self._random = random.Random(number)

    async def ask(self, method: str, path: str, body: Any = None) -> Any:
        """The parsed answer; a connection that the server closed while idle is opened again."""
        encoded = None if body is None else json.dumps(body).encode()
        sent = request(method, path, self._host, self._token, encoded)
        for _ in range(3):
            try:
                status, answer = await self._connection.ask(sent)
                break
            except OSError:
                self._tally.notes["a connection was lost and the request sent again"] += 1
        else:
            raise OSError("no answer after three connections")
        if status != 200:
            raise ValueError(f"{method} {path.partition('?')[0][:12]}: {status} {answer[:200]!r}")
        return answer if path.startswith(("/media", "/experimenter")) else json.loads(answer)

    async def begin(self) -> None:
        """Enter as a new participant, up to the first test trial."""
        self._token = ""
        self._life += 1
        who = {"id": f"load-{self._number}-{self._life}", "pass": self._word, "language": "en"}
        entered = await self.ask("POST", "/api/enter", who)
        self._token = entered["token"]
        self._reference = entered["state"]["reference"]
        await self.ask("POST", "/api/page", {"page": "consent", "data": {"agreed": True}})
        await self.ask("POST", "/api/page", {"page": "instructions", "data": {}})
        practice = await self.ask("GET", "/api/trials/familiarization")
        for media in practice["trials"]:
            await self.answer("familiarization", media)
        await self.ask("POST", "/api/page", {"page": "ready", "data": {}})
        self._trials = (await self.ask("GET", "/api/trials/test"))["trials"]
        self._next = 0

    async def answer(self, phase: str, media: dict[str, Any]) -> None:
        """Post one answer of the size that the pages send, and note the acknowledgement."""
        response = self._random.choice(("yes", "no"))
        rt_ms = round(self._random.lognormvariate(6.7, 0.4), 1)
        moments = [round(frame * 1000 / 30 + self._random.random(), 1) for frame in range(45)]
        body = {
            "key": str(uuid.UUID(int=self._random.getrandbits(128))),
            "phase": phase,
            "trial": media["trial"],
            "response": response,
            "rt_ms": rt_ms,
            "input": "keyboard",
            "fixation_ms": media["fixation_ms"],
            "cue_ms": 2000.3,
            "frames_shown": 45,
            "frames_dropped": 0,
            "movie_ms": 1466.7,
            "visibility_changes": 0,
            "window_width": 1280,
            "window_height": 720,
            "details": {"frames_ms": moments, "cue_ms": [0.0, 250.1, 500.2, 750.1, 1000.0]},
        }
        showing = {"key": body["key"], "phase": phase, "trial": media["trial"]}
        await self.ask("POST", "/api/showings", showing)
        begin = time.perf_counter()
        await self.ask("POST", "/api/answers", body)
        if phase == "test":
            self._tally.seconds.append(time.perf_counter() - begin)
        found = (self._reference, int(media["trial"]), response, rt_ms)
        self._tally.answers[body["key"]] = found

    async def fetch(self, media: dict[str, Any]) -> None:
        """The movie and the map of a trial."""
        for kind in ("movie", "map"):
            self._tally.fetched += 1
            self._tally.fetched_bytes += len(await self.ask("GET", media[kind]))

    async def paced(self, every: float, until: float, media: bool) -> None:
        """One answer every ``every`` seconds, the first at a random moment within them."""
        due = time.perf_counter() + self._random.random() * every
        while due < until:
            await asyncio.sleep(max(0.0, due - time.perf_counter()))
            if self._next == len(self._trials):
                await self.begin()
            trial = self._trials[self._next]
            if media:
                await self.fetch(trial)
            await self.answer("test", trial)
            self._next += 1
            due += every

    async def full(self, until: float) -> None:
        """One answer after the other."""
        while time.perf_counter() < until:
            if self._next == len(self._trials):
                await self.begin()
            await self.answer("test", self._trials[self._next])
            self._next += 1


async def guarded(work: Any, tally: Tally) -> None:
    """Await; what goes wrong is counted and ends this participant."""
    try:
        await work
    except (OSError, ValueError, KeyError) as error:
        tally.errors[f"{type(error).__name__}: {error}"[:200]] += 1


async def experimenter(port: int, until: float, tally: Tally) -> None:
    """Log in and reload the overview every 2 s."""
    import httpx2

    async with httpx2.AsyncClient(
        base_url=f"http://{HOST}:{port}", trust_env=False, follow_redirects=True, timeout=30.0
    ) as browser:
        await log_in(browser)
        while time.perf_counter() < until:
            page = await browser.get("/experimenter")
            if page.status_code != 200 or "/logout" not in page.text:
                tally.errors[f"overview: {page.status_code}"] += 1
            tally.reload_seconds.append(page.elapsed.total_seconds())
            await asyncio.sleep(2)


async def log_in(browser: Any) -> None:
    """Log in as the login page does."""
    origin = {"origin": str(browser.base_url)}
    answer = await browser.post("/experimenter/login", data={"password": PASSWORD}, headers=origin)
    if answer.status_code != 200 or "/logout" not in answer.text:
        raise ValueError(f"login: {answer.status_code}")


async def play(name: str, server: ServerProcess, word: str, options: argparse.Namespace) -> Row:
    """One load; what was counted and measured while it ran."""
    tally = Tally()
    people = [Participant(n, server.port, word, tally) for n in range(options.people)]
    await asyncio.gather(*(guarded(person.begin(), tally) for person in people))
    if tally.errors:
        raise SystemExit(f"{name}: not everybody could begin: {tally.errors.most_common(3)}")
    begin, spent, own = time.perf_counter(), cpu_seconds(server.pid), time.process_time()
    tally.seconds.clear()
    if name == "full":
        until = begin + options.full
        work = [person.full(until) for person in people]
    else:
        until = begin + options.seconds
        work = [person.paced(options.every, until, name == "media") for person in people]
        if name == "media":
            work.append(experimenter(server.port, until, tally))
    await asyncio.gather(*(guarded(one, tally) for one in work))
    wall = time.perf_counter() - begin
    for person in people:
        person.close()
    seconds = np.array(tally.seconds or [np.nan]) * 1000
    return Row(
        name,
        tally,
        wall,
        *(float(np.percentile(seconds, share)) for share in (50, 99, 100)),
        server_cpu=(cpu_seconds(server.pid) - spent) / wall,
        client_cpu=(time.process_time() - own) / wall,
    )


def cpu_seconds(pid: int) -> float:
    """Processor time of another process so far (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def check(study: Study, tally: Tally) -> int:
    """Answers that are not as acknowledged: missing, altered, or never acknowledged."""
    columns = (ANSWERS.c.key, SESSIONS.c.reference, ANSWERS.c.trial, ANSWERS.c.response,
               ANSWERS.c.rt_ms)  # fmt: skip
    engine = open_database(study.folder)
    with engine.connect() as connection:
        rows = connection.execute(sa.select(*columns).join(SESSIONS)).all()
    engine.dispose()
    stored = Counter((str(key), tuple(rest)) for key, *rest in rows)
    sent = Counter((key, answer) for key, answer in tally.answers.items())
    return (stored - sent).total() + (sent - stored).total()


def measure(name: str, options: argparse.Namespace, folder: Path) -> Row:
    """Make a study, serve it, load it, stop, and look everything up."""
    from physion.experiment.study.settings import Plausibility
    from support.experiment.tiny_study import make_tiny_study

    # Every answer is checked, at a speed that the participants of a load can keep.
    checked = Plausibility(simulated_speed=1_000_000)
    study = make_tiny_study(folder / name, test=TEST_TRIALS, plausibility=checked)
    words = [sys.executable]
    if options.profile:
        words += ["-m", "cProfile", "-o", str(options.profile)]
    word = make_pass(Secrets.load(study.folder), "simulated")
    command = (*words, "-m", "physion.cli.main")
    with ServerProcess(study.folder, command=command) as server:
        row = uvloop.run(play(name, server, word, options))
    row.wrong = check(study, row.tally)
    return row


COLUMNS = ("load", "answers", "answers/s", "errors", "p50, ms", "p99, ms", "slowest, ms",
           "wrong in the database", "server, cores", "client, cores")  # fmt: skip


def table(rows: list[Row]) -> str:
    """The rows as a Markdown table."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    for row in rows:
        count = len(row.tally.seconds)
        cells = (row.name, f"{count:,}", f"{count / row.wall_s:.0f}", row.tally.failures,
                 f"{row.p50_ms:.1f}", f"{row.p99_ms:.1f}", f"{row.slowest_ms:.0f}", row.wrong,
                 f"{row.server_cpu:.2f}", f"{row.client_cpu:.2f}")  # fmt: skip
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def report(rows: list[Row], options: argparse.Namespace) -> str:
    """What was found, as a page."""
    lines = [
        "# Load of the experiment's server",
        "",
        f"`{' '.join(['python', *sys.argv])}`, {datetime.now(UTC):%Y-%m-%d}, "
        f"{processor()}, {os.cpu_count()} cores for server and clients together, "
        f"Python {platform.python_version()}, load average before {options.load_before:.1f}. "
        f"{options.people} participants, {TEST_TRIALS} test trials each; a synced write of 4 KiB "
        f"takes {options.sync_ms:.2f} ms here (median).",
        "",
        table(rows),
        "",
        f"To reach: no error and p99 under {AIM_P99_MS} ms where paced (one answer every "
        f"{options.every:g} s each for {options.seconds:g} s), {AIM_ANSWERS_PER_S} answers/s at "
        f"full speed ({options.full:g} s). Every acknowledged answer was looked for in the "
        "database.",
    ]
    for row in rows:
        seen = {**row.tally.errors, **row.tally.notes}
        lines += [f"- {row.name}: {count} times {what}" for what, count in sorted(seen.items())]
        if row.tally.fetched:
            reloads = row.tally.reload_seconds
            lines.append(
                f"- {row.name}: {row.tally.fetched:,} files fetched "
                f"({row.tally.fetched_bytes / 1e6:.0f} MB); {len(reloads)} reloads of the "
                f"overview, slowest {max(reloads, default=0):.2f} s"
            )
    return "\n".join(lines) + "\n"


def sync_ms(folder: Path, count: int = 100) -> float:
    """Median milliseconds of a write of 4 KiB that is on the disk when it returns."""
    seconds = []
    with (folder / "sync").open("wb") as file:
        for _ in range(count):
            begin = time.perf_counter()
            file.write(bytes(4096))
            file.flush()
            os.fdatasync(file.fileno())
            seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds)) * 1000


def main() -> None:
    """Measure, print, and write if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=180, help="length of paced and media")
    parser.add_argument("--full", type=float, default=20, help="seconds at full speed")
    parser.add_argument("--people", type=int, default=200)
    parser.add_argument("--every", type=float, default=6, help="seconds between two answers")
    parser.add_argument("--loads", nargs="+", choices=LOADS, default=LOADS)
    parser.add_argument("--folder", type=Path, help="where studies are made, on the disk to test")
    parser.add_argument("--profile", type=Path, help="file for the server's profile")
    parser.add_argument("--write", action="store_true", help="keep the result in results/")
    options = parser.parse_args()
    options.load_before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(dir=options.folder) as temporary:
        options.sync_ms = sync_ms(Path(temporary))
        rows = [measure(name, options, Path(temporary)) for name in options.loads]
    text = report(rows, options)
    print(text)
    if options.write:
        (RESULTS / "experiment_load.md").write_text(text)
    failed = any(row.tally.failures or row.wrong for row in rows)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
