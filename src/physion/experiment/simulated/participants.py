"""Simulated participants, who go through a served study by HTTP as a browser does.

They enter with the signed word of the pilot link, which marks their sessions as simulated for good,
load the pages' data and media, answer every trial with a key that is kept over retries, and fill in
the pages, each with a `SimulatedBrowser`. What they answer is `SimulatedPerson`'s: the outcomes
come from the study folder, never from the server. Nothing is waited for but ``pace``; the times of
cue, movie and frames that they report are the wanted ones.
"""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import httpx2

from physion.errors import PhysionError, UnknownNameError
from physion.experiment.protocol import messages as wire
from physion.experiment.simulated.browser import RefusedError, SimulatedBrowser, state_after
from physion.experiment.simulated.person import SimulatedPerson
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import pass_word
from physion.experiment.study.stimuli import Stimulus
from physion.experiment.study.study import Study
from physion.experiment.web.media_links import read_media_path

DEVICE = wire.Device(
    user_agent="physion simulate",
    refresh_hz=60.0,
    screen_width=1920,
    screen_height=1080,
    pixel_ratio=1.0,
    touch=False,
)
WINDOW = (1280, 720)


@dataclass(frozen=True)
class Acknowledged:
    """An answer of which the server said that it is stored."""

    phase: wire.Phase
    trial: int
    key: str
    stimulus: str
    response: str
    rt_ms: float


@dataclass
class Visit:
    """What became of one simulated participant."""

    number: int
    scenario: str
    outcome: Literal["done", "done before", "left", "refused", "failed"] = "failed"
    reference: str = ""
    reason: str = ""
    retries: int = 0
    answers: list[Acknowledged] = field(default_factory=list)
    result: wire.Result | None = None


@dataclass(frozen=True)
class Plan:
    """How a simulation goes. ``pace``: seconds before each answer. ``dropouts``: share of people
    who close the page before a random test trial. ``at_once``: so many people at the same time.
    ``waits_s``: the pauses before a request is sent again double from the first to the second.
    ``patience_s``: how long a request is tried. ``media``: fetch movies and maps, too.
    """

    url: str
    participants: int = 20
    scenario: str | None = None
    pace: float = 0.0
    seed: int = 0
    dropouts: float = 0.1
    at_once: int = 50
    waits_s: tuple[float, float] = (0.1, 2.0)
    patience_s: float = 60.0
    media: bool = True


class Participation:
    """One simulated person's way through the study, from wherever the session stands."""

    def __init__(self, study: Study, secrets: Secrets, plan: Plan, visit: Visit) -> None:
        self._study, self._secrets, self._plan, self._visit = study, secrets, plan, visit
        self._person = SimulatedPerson(plan.seed, visit.number)

    async def go(self, client: httpx2.AsyncClient) -> None:
        """Go through; what came of it is in the visit."""
        self._browser = SimulatedBrowser(client, self._plan.waits_s, self._plan.patience_s)
        try:
            await self._walk()
        except RefusedError as refused:
            before = refused.code == "already_took_part"
            self._visit.outcome = "done before" if before else "refused"
            self._visit.reason = f"{refused.code}: {refused}"
        except PhysionError as error:
            self._visit.outcome, self._visit.reason = "failed", str(error)
        finally:
            self._visit.retries = self._browser.retries

    async def _walk(self) -> None:
        public = wire.PublicStudy.model_validate_json(await self._browser.ask("GET", "/api/study"))
        await self._browser.ask("GET", f"/api/texts/{public.languages[0]}")
        state = await self._enter(public.languages[0])
        if state.stage == "done":
            self._visit.outcome = "done before"
            return
        leaves = self._person.leaves_before(state.trials["test"], self._plan.dropouts)
        while state.stage not in ("done", "withdrawn"):
            if state.stage in ("familiarization", "test"):
                state = await self._phase(state, leaves)
                if state.stage == "test" and state.trial == leaves:
                    self._visit.outcome = "left"
                    return
            else:
                state = await self._page(state)
        answer = await self._browser.ask("GET", "/api/result")
        self._visit.result = wire.Result.model_validate_json(answer)
        self._visit.outcome = "done"

    async def _enter(self, language: str) -> wire.State:
        who = {
            "id": f"simulated-{self._plan.seed}-{self._visit.number}",
            "scenario": self._visit.scenario,
            "language": language,
            "pass": pass_word(self._secrets, "simulated"),
            "device": DEVICE,
        }
        enter = wire.Enter.model_validate(who)
        answer = await self._browser.ask("POST", "/api/enter", enter)
        entered = wire.Entered.model_validate_json(answer)
        if entered.state.kind != "simulated":
            raise PhysionError("the server does not mark this session as simulated; stopped")
        self._browser.token = entered.token
        self._visit.reference = entered.state.reference
        answer = await self._browser.ask("GET", "/api/session?load=true")
        return wire.State.model_validate_json(answer)

    async def _page(self, state: wire.State) -> wire.State:
        filled: dict[str, Any] = {
            "consent": {"agreed": True},
            "demographics": self._person.demographics(),
            "feedback": self._person.feedback(),
        }
        page = {"page": state.stage, "data": filled.get(state.stage, {})}
        done = wire.PageDone.model_validate(page)
        try:
            answer = await self._browser.ask("POST", "/api/page", done)
        except RefusedError as refused:
            return state_after(refused)
        return wire.State.model_validate_json(answer)

    async def _phase(self, state: wire.State, leaves: int | None) -> wire.State:
        phase = state.stage
        assert phase == "familiarization" or phase == "test"
        answer = await self._browser.ask("GET", f"/api/trials/{phase}")
        trials = wire.TrialList.model_validate_json(answer).trials
        while state.stage == phase and state.trial is not None:
            if phase == "test" and state.trial == leaves:
                break
            state = await self._trial(phase, trials[state.trial])
        return state

    async def _trial(self, phase: wire.Phase, media: wire.TrialMedia) -> wire.State:
        await self._fetch(media.movie, media.map)
        stimulus = self._shown(phase, media.movie)
        body = answer_to(self._study, media, phase, self._person, stimulus)
        await asyncio.sleep(self._plan.pace)
        try:
            answer = await self._browser.ask("POST", "/api/answers", body)
        except RefusedError as refused:
            return state_after(refused)
        stored = wire.AnswerStored.model_validate_json(answer)
        self._visit.answers.append(
            Acknowledged(phase, body.trial, body.key, stimulus.stimulus, body.response, body.rt_ms)
        )
        if stored.feedback is not None:
            await self._fetch(stored.feedback.movie)
        return stored.state

    def _shown(self, phase: wire.Phase, movie: str) -> Stimulus:
        """What a movie's path stands for; the server's keys can tell, a browser cannot."""
        path = read_media_path(self._study, self._secrets, movie)
        for stimulus in self._study.phase(self._visit.scenario, phase):
            if self._study.folder / stimulus.movie == path:
                return stimulus
        raise PhysionError(f"{movie} is no movie of {self._study.folder}: is it another study's?")

    async def _fetch(self, *paths: str) -> None:
        for path in paths if self._plan.media else ():
            if not await self._browser.ask("GET", path):
                raise PhysionError(f"{path}: the server sent an empty file")


def answer_to(
    study: Study,
    media: wire.TrialMedia,
    phase: wire.Phase,
    person: SimulatedPerson,
    stimulus: Stimulus,
) -> wire.Answer:
    """What the pages would post for this trial, with a new key."""
    prediction = person.predict(stimulus)
    frame_ms = 1000 / media.rate
    moments = [round(frame * frame_ms, 1) for frame in range(media.frames)]
    return wire.Answer(
        key=str(uuid.uuid4()),
        phase=phase,
        trial=media.trial,
        response=prediction.response,
        rt_ms=prediction.rt_ms,
        input="keyboard" if person.number % 2 else "mouse",
        fixation_ms=media.fixation_ms,
        cue_ms=study.timing.cue_ms,
        frames_shown=media.frames,
        frames_dropped=0,
        movie_ms=moments[-1],
        visibility_changes=0,
        window_width=WINDOW[0],
        window_height=WINDOW[1],
        details={"simulated": True, "frames_ms": moments},
    )


async def simulate(
    study: Study,
    secrets: Secrets,
    plan: Plan,
    visited: Callable[[Visit], None] = lambda visit: None,
) -> list[Visit]:
    """Send the participants through; each finished visit is passed to ``visited``.

    The same seed sends the same people: those who finished are left as they are, the others go on.
    """
    if plan.scenario is not None and plan.scenario not in study.scenarios:
        raise UnknownNameError("scenario", plan.scenario, study.scenarios)
    scenarios = study.scenarios if plan.scenario is None else (plan.scenario,)
    visits = [Visit(n, scenarios[n % len(scenarios)]) for n in range(plan.participants)]
    seats = asyncio.Semaphore(plan.at_once)
    limits = httpx2.Limits(max_connections=plan.at_once, max_keepalive_connections=plan.at_once)
    async with httpx2.AsyncClient(
        base_url=plan.url, timeout=30.0, limits=limits, trust_env=False
    ) as client:

        async def one(visit: Visit) -> None:
            async with seats:
                await Participation(study, secrets, plan, visit).go(client)
            visited(visit)

        async with asyncio.TaskGroup() as people:
            for visit in visits:
                people.create_task(one(visit))
    return visits
