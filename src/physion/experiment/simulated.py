"""Simple response model of a simulated participant: accuracy, response bias and response time.

An answer is correct with probability logistic(``ability`` + ``easiness`` of the stimulus), as in
the Rasch model; ``bias`` towards "yes" is added on the same scale. Response times are log-normal
and longer for hard stimuli. The model does not look at movies: it is given the outcome of each
stimulus. All draws follow from the seed, the person's number and the stimulus, so a participant who
comes back gives the same answer again.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import httpx2
import numpy as np

from physion.core.errors import PhysionError, UnknownNameError
from physion.core.seeds import generator
from physion.experiment import protocol as wire
from physion.experiment.protocol import ENDED, Phase, PublicStudy
from physion.experiment.study.identity import Secrets
from physion.experiment.study.media import read_media_path
from physion.experiment.study.orders import trial_order
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import Answer, Question
from physion.experiment.study.stimuli import ATTENTION, PHASES, STIMULUS_PHASES, Stimulus
from physion.experiment.study.study import Study

ABILITY = (1.2, 0.35)
"""Mean and standard deviation over people, in log odds of a correct answer."""
EASINESS_SD = 1.3
"""Standard deviation over stimuli, in log odds; the same for all people and simulations."""
BIAS_SD = 0.2
"""Standard deviation over people of the bias towards yes, in log odds."""
LOG_RT = 6.6
"""Mean logarithm of the response time in milliseconds when a correct answer is certain."""
LOG_RT_HARD = 0.4
"""Added to the mean logarithm, times the probability of a wrong answer."""
TYPICAL_RT_MS = 800.0
"""Typical response time in milliseconds, for estimates of durations."""
LOG_RT_SD = (0.2, 0.35)
"""Standard deviations over people, and over the trials of one person."""
GENDERS = ("female", "male", "")
EDUCATIONS = ("secondary", "bachelor", "")


@dataclass(frozen=True)
class Prediction:
    """A simulated answer. ``rt_ms`` counts from the moment the buttons are enabled."""

    response: Literal["yes", "no"]
    rt_ms: float


@dataclass(frozen=True)
class SimulatedPerson:
    """Person ``number`` of the simulation with this ``seed``."""

    seed: int
    number: int

    def _rng(self, *names: str | int) -> np.random.Generator:
        """Return the generator of one named draw of this person."""
        return generator("simulated", self.seed, self.number, *names)

    def probability_correct(self, stimulus: Stimulus) -> float:
        """Return the probability of a correct answer, without response bias."""
        ability = self._rng("ability").normal(*ABILITY)
        easiness = generator("easiness", stimulus.stimulus).normal(0, EASINESS_SD)
        return float(_logistic(ability + easiness))

    def predict(self, stimulus: Stimulus) -> Prediction:
        """Return the answer to a stimulus; the same one on every call."""
        correct = self.probability_correct(stimulus)
        log_odds = np.log(correct / (1 - correct)) * (1 if stimulus.label else -1)
        rng = self._rng("answer", stimulus.phase, stimulus.stimulus)
        bias = self._rng("lean").normal(0, BIAS_SD)
        yes = rng.random() < _logistic(log_odds + bias)
        slowness = self._rng("slow").normal(0, LOG_RT_SD[0])
        log_rt = LOG_RT + LOG_RT_HARD * (1 - correct) + slowness + rng.normal(0, LOG_RT_SD[1])
        return Prediction("yes" if yes else "no", round(float(np.exp(log_rt)), 1))

    def dropout_trial(self, trials: int, dropouts: float) -> int | None:
        """Return the test trial before which the person leaves for good, or None if never."""
        rng = self._rng("leaves")
        leaves = rng.random() < dropouts
        return int(rng.integers(trials)) if leaves and trials else None

    def demographics(self) -> dict[str, bool | int | float | str | None]:
        """Return the fields of the demographics page."""
        rng = self._rng("demographics")
        return {
            "age": int(rng.integers(18, 70)),
            "gender": GENDERS[rng.integers(len(GENDERS))],
            "education": EDUCATIONS[rng.integers(len(EDUCATIONS))],
        }

    def own_answers(self, questions: Sequence[Question]) -> dict[str, Answer]:
        """Return answers to the lab's own questions, drawn at random; texts are marked."""
        answers: dict[str, Answer] = {}
        for question in questions:
            rng = self._rng("question", question.name)
            match question.kind:
                case "text":
                    answers[question.name] = "simulated"
                case "scale":
                    answers[question.name] = int(rng.integers(1, question.steps + 1))
                case "choice":
                    answers[question.name] = question.options[rng.integers(len(question.options))]
                case _:
                    chosen = [option for option in question.options if rng.random() < 0.5]
                    answers[question.name] = chosen or [question.options[0]]
        return answers

    def feedback(self) -> dict[str, bool | int | float | str | None]:
        """Return the fields of the feedback page, whose text is marked as simulated."""
        difficulty = int(self._rng("difficulty").integers(1, 6))
        return {"difficulty": difficulty, "technical_problems": False, "text": "simulated"}


def _logistic(log_odds: float) -> float:
    """Return the probability of log odds."""
    return float(1 / (1 + np.exp(-log_odds)))


# HTTP client of a simulated participant, with the same retries as the browser pages.

AT_ONCE = 50
"""Largest number of simulated participants at the same time."""
GO_ON = ("out_of_order", "already_answered", "wrong_stage", "not_shown")
"""Refusals that carry the session's state, with which the participant continues."""


class RefusedError(PhysionError):
    """Refusal by the server: a ``code`` of `protocol.REFUSALS` and the session's state, if sent."""

    def __init__(self, refusal: wire.Refusal) -> None:
        super().__init__(refusal.message)
        self.code, self.state = refusal.error, refusal.state


class SimulatedBrowser:
    """Client of one visitor that retries each request until the server answers.

    Parameters
    ----------
    client
        The shared HTTP client.
    waits_s
        First and longest pause between retries in seconds; the pause doubles in between.
    patience_s
        Seconds after which a request is given up.
    """

    def __init__(
        self, client: httpx2.AsyncClient, waits_s: tuple[float, float], patience_s: float
    ) -> None:
        self._client, self._waits_s, self._patience_s = client, waits_s, patience_s
        self.token = ""
        self.retries = 0

    async def ask(self, method: str, path: str, body: wire.Message | None = None) -> bytes:
        """Send a request and return the body of the response.

        Raises
        ------
        RefusedError
            The server refused the request.
        PhysionError
            The server did not answer within ``patience_s``.
        """
        content = None if body is None else body.model_dump_json(by_alias=True, exclude_none=True)
        headers = {"Authorization": f"Bearer {self.token}"} if self.token else {}
        if content is not None:
            headers["Content-Type"] = "application/json"
        (wait, longest), until = self._waits_s, time.monotonic() + self._patience_s
        while True:
            trouble = "the server does not answer"
            try:
                answer = await self._client.request(method, path, content=content, headers=headers)
            except httpx2.TransportError as error:
                trouble = f"the server does not answer ({type(error).__name__})"
            else:
                if answer.is_success:
                    return answer.content
                if answer.status_code not in (425, 429) and answer.status_code < 500:
                    raise RefusedError(_refusal(answer))
                trouble = f"the server answers {answer.status_code}"
            if time.monotonic() > until:
                raise PhysionError(f"{method} {path}: {trouble} for {self._patience_s:g} s")
            self.retries += 1
            await asyncio.sleep(wait)
            wait = min(2 * wait, longest)


def _refusal(answer: httpx2.Response) -> wire.Refusal:
    """Return the refusal in a response; a generic one if the body is not a `Refusal`."""
    try:
        return wire.Refusal.model_validate_json(answer.content)
    except ValueError:
        return wire.Refusal(error="bad_request", message=f"status {answer.status_code}")


def state_after(refused: RefusedError) -> wire.SessionState:
    """Return the state with which to continue after a refusal; raise the refusal if it has none."""
    if refused.code in GO_ON and refused.state is not None:
        return refused.state
    raise refused


# Simulated participants who complete a served study over HTTP, as a browser would.
#
# They enter with the signed key of the pilot link, which marks their sessions as simulated for
# good. Each uses a `SimulatedBrowser` to load the pages' data and media, answer every trial (with
# a key that stays the same over retries) and submit the pages. The answers come from
# `SimulatedPerson`, which reads the outcomes from the study folder, never from the server. They
# announce each trial and wait for cross, cue, movie, response time and feedback as a browser does;
# a study may let their time pass faster (``plausibility.simulated_speed``). The reported times are
# the nominal ones.

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
    """An answer that the server acknowledged as stored."""

    phase: Phase
    trial: int
    key: str
    stimulus: str
    response: str
    rt_ms: float


@dataclass
class SimulatedVisit:
    """Record of one simulated participant: what happened and what was answered."""

    number: int
    scenario: str
    outcome: Literal["done", "done before", "left", "screened out", "refused", "failed"] = "failed"
    reference: str = ""
    reason: str = ""
    retries: int = 0
    answers: list[Acknowledged] = field(default_factory=list)
    result: wire.Result | None = None


@dataclass(frozen=True)
class SimulationPlan:
    """Settings of a simulation.

    Parameters
    ----------
    url
        URL of the served study.
    participants
        Number of participants.
    seed
        Seed of all random draws.
    scenario
        The scenario of everybody; all scenarios in rotation if None.
    dropouts
        Fraction of people who close the page before a random test trial.
    waits_s
        First and longest pause between retries of a request in seconds.
    patience_s
        Seconds after which a request is given up.
    """

    url: str
    participants: int = 20
    scenario: str | None = None
    seed: int = 0
    dropouts: float = 0.1
    waits_s: tuple[float, float] = (0.1, 2.0)
    patience_s: float = 60.0


class Participation:
    """A simulated person's session, from its current state to its end."""

    def __init__(
        self, study: Study, secrets: Secrets, plan: SimulationPlan, visit: SimulatedVisit
    ) -> None:
        self._study, self._secrets, self._plan, self._visit = study, secrets, plan, visit
        self._person = SimulatedPerson(plan.seed, visit.number)

    async def run(self, client: httpx2.AsyncClient) -> None:
        """Run the session and record its outcome in the visit."""
        self._browser = SimulatedBrowser(client, self._plan.waits_s, self._plan.patience_s)
        try:
            await self._run_stages()
        except RefusedError as refused:
            before = refused.code == "already_took_part"
            self._visit.outcome = "done before" if before else "refused"
            self._visit.reason = f"{refused.code}: {refused}"
        except PhysionError as error:
            self._visit.outcome, self._visit.reason = "failed", str(error)
        finally:
            self._visit.retries = self._browser.retries

    async def _run_stages(self) -> None:
        """Enter and run all stages of the session."""
        public = PublicStudy.model_validate_json(await self._browser.ask("GET", "/api/study"))
        await self._browser.ask("GET", f"/api/texts/{public.languages[0]}")
        state = await self._enter(public.languages[0])
        if state.stage == "done":
            self._visit.outcome = "done before"
            return
        dropout = self._person.dropout_trial(state.trials["test"], self._plan.dropouts)
        while state.stage not in ("done", *ENDED):
            if state.stage in ("familiarization", "test"):
                state = await self._run_phase(state, dropout)
                if state.stage == "test" and state.trial == dropout:
                    self._visit.outcome = "left"
                    return
            else:
                state = await self._submit_page(state)
        if state.ended:
            self._visit.outcome = "screened out"
            return
        answer = await self._browser.ask("GET", "/api/result")
        self._visit.result = wire.Result.model_validate_json(answer)
        self._visit.outcome = "done"

    async def _enter(self, language: str) -> wire.SessionState:
        """Enter by the pilot link and return the state of the session."""
        who = {
            "id": f"simulated-{self._plan.seed}-{self._visit.number}",
            "scenario": self._visit.scenario,
            "language": language,
            "pass": make_pass(self._secrets, "simulated"),
            "device": DEVICE,
        }
        enter = wire.Enter.model_validate(who)
        answer = await self._browser.ask("POST", "/api/enter", enter)
        entered = wire.Entered.model_validate_json(answer)
        if entered.state.kind != "simulated":
            raise PhysionError("stopped: the server does not mark this session as simulated")
        self._browser.token = entered.token
        self._visit.reference = entered.state.reference
        if entered.state.stage == "consent":
            return entered.state
        answer = await self._browser.ask("GET", "/api/session?load=true")
        return wire.SessionState.model_validate_json(answer)

    async def _submit_page(self, state: wire.SessionState) -> wire.SessionState:
        """Submit the page of the current stage."""
        filled: dict[str, Any] = {
            "consent": {"agreed": True},
            "demographics": self._person.demographics(),
            "comprehension": {
                each.name: each.right for each in self._study.comprehension_questions
            },
            "questions": self._person.own_answers(self._study.questions),
            "feedback": self._person.feedback(),
        }
        page = {"page": state.stage, "data": filled.get(state.stage, {})}
        done = wire.PageDone.model_validate(page)
        if state.stage == "consent":
            await self._live(1000 * self._study.plausibility.reading_s)
        try:
            answer = await self._browser.ask("POST", "/api/page", done)
        except RefusedError as refused:
            if refused.code == "unknown_token" and state.stage == "consent":
                # The server was started again and knows nobody who had not agreed.
                return await self._enter(state.language)
            return state_after(refused)
        return wire.SessionState.model_validate_json(answer)

    async def _run_phase(self, state: wire.SessionState, dropout: int | None) -> wire.SessionState:
        """Answer the remaining trials of a phase, up to the dropout trial."""
        phase = state.stage
        assert phase == "familiarization" or phase == "test"
        answer = await self._browser.ask("GET", f"/api/trials/{phase}")
        trials = wire.TrialList.model_validate_json(answer).trials
        while state.stage == phase and state.trial is not None:
            if phase == "test" and state.trial == dropout:
                break
            state = await self._run_trial(phase, trials[state.trial], state.settings.cue_ms)
        return state

    async def _run_trial(
        self, phase: Phase, media: wire.TrialMedia, cue_ms: int
    ) -> wire.SessionState:
        """Fetch the media of a trial and answer it."""
        await self._fetch(media.movie, media.map)
        stimulus = self._find_stimulus(phase, media)
        body = build_answer(cue_ms, media, phase, self._person, stimulus)
        showing = wire.Showing(key=uuid.uuid4().hex, phase=phase, trial=media.trial)
        try:
            await self._browser.ask("POST", "/api/showings", showing)
            await self._live(media.fixation_ms + cue_ms)
            await self._live(1000 * media.frames / media.rate + body.rt_ms)
            answer = await self._browser.ask("POST", "/api/answers", body)
        except RefusedError as refused:
            return state_after(refused)
        stored = wire.AnswerStored.model_validate_json(answer)
        self._visit.answers.append(
            Acknowledged(phase, body.trial, body.key, stimulus.stimulus, body.response, body.rt_ms)
        )
        if stored.feedback is not None:
            await self._fetch(stored.feedback.movie)
            await self._live(1000 * stored.feedback.frames / media.rate)
        return stored.state

    async def _live(self, ms: float) -> None:
        """Let ``ms`` milliseconds of a person's time pass, at the speed that the study allows."""
        await asyncio.sleep(ms / 1000 / self._study.plausibility.simulated_speed)

    def _find_stimulus(self, phase: Phase, media: wire.TrialMedia) -> Stimulus:
        """Return the stimulus of a trial by its movie, whose path the server's keys decode."""
        path = read_media_path(self._study, self._secrets, media.movie)
        # Instructed attention checks show movies of the practice.
        phases = STIMULUS_PHASES if media.instructed else (phase, ATTENTION)
        for stimulus in self._study.stimuli:
            fits = self._visit.scenario == stimulus.scenario and stimulus.phase in phases
            if fits and self._study.folder / stimulus.movie == path:
                return stimulus
        raise PhysionError(
            f"{media.movie} is not a movie of {self._study.folder}; does the server serve another "
            "study?"
        )

    async def _fetch(self, *paths: str) -> None:
        """Fetch media."""
        for path in paths:
            if not await self._browser.ask("GET", path):
                raise PhysionError(f"{path}: the server sent an empty file")


def build_answer(
    cue_ms: int,
    media: wire.TrialMedia,
    phase: Phase,
    person: SimulatedPerson,
    stimulus: Stimulus,
) -> wire.Answer:
    """Return the message with a person's answer to a trial, as the pages would send it.

    Parameters
    ----------
    cue_ms
        Duration of the cue in the condition of the session.
    media
        The trial as the server listed it.
    phase
        Phase of the trial.
    person
        Who answers.
    stimulus
        The stimulus that the trial shows.

    Returns
    -------
    The answer, with a new key.
    """
    prediction = person.predict(stimulus)
    response = media.instructed or prediction.response
    if stimulus.phase == ATTENTION:
        response = "yes" if stimulus.label else "no"
    frame_ms = 1000 / media.rate
    frame_times = [round(frame * frame_ms, 1) for frame in range(media.frames)]
    return wire.Answer(
        key=str(uuid.uuid4()),
        phase=phase,
        trial=media.trial,
        response=response,
        rt_ms=prediction.rt_ms,
        input="keyboard" if person.number % 2 else "mouse",
        fixation_ms=media.fixation_ms,
        cue_ms=cue_ms,
        frames_shown=media.frames,
        frames_dropped=0,
        movie_ms=frame_times[-1],
        visibility_changes=0,
        window_width=WINDOW[0],
        window_height=WINDOW[1],
        details={"simulated": True, "frames_ms": frame_times},
    )


def minutes_each(study: Study, scenario: str) -> float:
    """Return about how many minutes a simulated participant takes, without breaks."""
    cross_ms = sum(study.timing.fixation_ms) / 2
    seconds = study.plausibility.reading_s
    order = trial_order(study, scenario, 0)
    for phase in PHASES:
        for stimulus in order[phase]:
            trial_ms = cross_ms + study.timing.cue_ms + TYPICAL_RT_MS
            seconds += trial_ms / 1000 + (stimulus.frames + stimulus.full_frames) / stimulus.rate
    return seconds / 60 / study.plausibility.simulated_speed


async def simulate(
    study: Study,
    secrets: Secrets,
    plan: SimulationPlan,
    visited: Callable[[SimulatedVisit], None] = lambda visit: None,
) -> list[SimulatedVisit]:
    """Run the simulated participants and return what happened to each.

    The same seed gives the same people: on a second run, those who had finished are left as they
    are and the others continue.

    Parameters
    ----------
    study
        The study that is served.
    secrets
        Its keys, for the pilot link and for decoding movie paths.
    plan
        Settings of the simulation.
    visited
        Called with each visit as it ends.

    Raises
    ------
    UnknownNameError
        The study has no such scenario.
    """
    if plan.scenario is not None and plan.scenario not in study.scenarios:
        raise UnknownNameError("scenario", plan.scenario, study.scenarios)
    scenarios = study.scenarios if plan.scenario is None else (plan.scenario,)
    visits = [SimulatedVisit(n, scenarios[n % len(scenarios)]) for n in range(plan.participants)]
    slots = asyncio.Semaphore(AT_ONCE)
    limits = httpx2.Limits(max_connections=AT_ONCE, max_keepalive_connections=AT_ONCE)
    async with httpx2.AsyncClient(
        base_url=plan.url, timeout=30.0, limits=limits, trust_env=False
    ) as client:

        async def run_one(visit: SimulatedVisit) -> None:
            async with slots:
                await Participation(study, secrets, plan, visit).run(client)
            visited(visit)

        async with asyncio.TaskGroup() as tasks:
            for visit in visits:
                tasks.create_task(run_one(visit))
    return visits
