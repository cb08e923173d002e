"""Leak tests: no response before an answer may reveal the outcome of a trial."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import pytest
from sqlalchemy import select

from physion.experiment.store.database import SESSIONS
from physion.experiment.study.identity import sign
from physion.experiment.study.media import NO_TAG, sign_media
from physion.experiment.study.orders import trial_order
from physion.experiment.study.stimuli import Stimulus
from physion.experiment.web.files import MEDIA_TYPES, PACKAGE
from support.experiment.app_walk import Person, Served, served
from support.experiment.tiny_study import FULL, OBSERVED, read_number

TRIALS = {"familiarization": 3, "test": 6}
PHASES = ("familiarization", "test")
ADDRESS = re.compile(
    r"/media/([tf]-\d+-(?:movie|map))-([0-9a-f]{16})-([0-9a-f]{16})-([0-9a-f]{32})"
)
TELLING = {"contact", "correct", "accuracy", "percentile", "label", "outcome", "score", "stimulus",
           "full", "place", "answer", "feedback"}  # fmt: skip
"""Names in messages that could reveal an outcome."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("leaks") / "study", participants=100, **TRIALS) as found:
        yield found


def numbers(movie: bytes) -> list[int]:
    """Return the frame numbers of a movie, decoded from its pixels."""
    with av.open(io.BytesIO(movie)) as container:
        return [
            read_number(frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)
        ]


def telling(value: Any) -> Iterator[tuple[str, Any]]:
    """Return all fields of a message that could reveal an outcome, with their values."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key in TELLING and inner is not None:
                yield key, inner
            yield from telling(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from telling(inner)


def secrets_of(site: Served) -> list[bytes]:
    """Return texts that no browser may ever receive: names of stimuli and files, keys, paths."""
    words = [str(site.study.folder), site.secrets.link_key.hex(), site.secrets.hash_key.hex()]
    for stimulus in site.study.stimuli:
        files = (stimulus.movie, stimulus.map, stimulus.full)
        words += [stimulus.stimulus, *(Path(name).name for name in files if name)]
    return [word.encode() for word in words]


def assert_silent(site: Served, answer: Any) -> None:
    """Check that neither body nor headers contain any of these texts."""
    everything = answer.content + str(dict(answer.headers)).encode()
    for word in secrets_of(site):
        assert word not in everything, word


def watch(site: Served, person: Person, phase: str, trial: int) -> None:
    """Fetch the media of a trial and check that they show only the observed frames."""
    listed = person.ask("GET", f"/api/trials/{phase}")["trials"][trial]
    movie, picture = site.client.get(listed["movie"]), site.client.get(listed["map"])
    person.heard += [("movie", movie), ("map", picture)]
    assert numbers(movie.content) == list(range(OBSERVED)), "frames beyond the observed ones"
    assert picture.headers["content-type"] == "image/png"


def test_a_session_reveals_no_outcome_before_the_answer(site: Served) -> None:
    person = Person(site.client)
    for path in ("/", "/api/study", "/api/texts/en", "/api/texts/de", "/api/health"):
        person.heard.append((path, site.client.get(path)))
    person.ask("POST", "/api/enter", {"id": "leak"})
    person.token = person.last["token"]
    person.ask("GET", "/api/session?load=true")
    person.page("consent")
    person.page("instructions")
    ends = {}
    for phase in PHASES:
        for trial in range(TRIALS[phase]):
            watch(site, person, phase, trial)
            person.state()
            person.ask("POST", "/api/events", {"events": []})
            person.ask("GET", "/api/result", status=403)
            person.answer(trial + 1, phase, 409)
            for path, answer in person.heard:
                assert_silent(site, answer)
                if answer.headers["content-type"] == "application/json" and "texts" not in path:
                    found = dict(telling(answer.json()))
                    assert found == (
                        {} if path != "/api/study" else {"contact": site.study.contact}
                    )
                assert b"-full-" not in answer.content
            person.heard.clear()
            stored = person.answer(trial, phase)
            if phase == "test":
                assert dict(telling(stored)) == {}
            else:
                ends[trial] = stored["feedback"]
                person.heard.clear()
        if phase == "familiarization":
            person.page("ready")
    practice = site.study.phase("collide", "familiarization")
    assert [ends[trial]["contact"] for trial in range(3)] == [each.label for each in practice]
    for name in ("demographics", "feedback"):
        person.ask("GET", "/api/result", status=403)
        person.page(name)
    for _, answer in person.heard:
        assert_silent(site, answer)
    result = person.ask("GET", "/api/result")
    assert result["correct"] == sum(each.label for each in site.study.phase("collide", "test"))
    assert_silent(site, person.heard[-1][1])


def test_static_files_contain_nothing_about_stimuli(site: Served) -> None:
    folder = PACKAGE / "static"
    served = []
    for path in (path for path in folder.rglob("*") if path.is_file()):
        answer = site.client.get(f"/static/{path.relative_to(folder).as_posix()}")
        # Scripts and notes next to the vendored files are not served.
        assert answer.status_code == (200 if path.suffix in MEDIA_TYPES else 404), path
        assert_silent(site, answer)
        served += [path.name] * (answer.status_code == 200)
    assert {"main.js", "pages.css", "icon.svg"} <= set(served)


def test_right_and_wrong_test_answers_get_the_same_response(site: Served) -> None:
    said = []
    for choice in ("yes", "no"):
        person = site.person(id=f"choice-{choice}").walk("test")
        for trial in range(TRIALS["test"]):
            person.answer(trial, response=choice)
            answer = person.heard[-1][1]
            state = answer.json()["state"]
            mine = answer.text.replace(state["reference"], "?").replace(state["buttons"], "?")
            said.append((choice, trial, mine, sorted(answer.headers)))
    half = TRIALS["test"]
    assert [one[1:] for one in said[:half]] == [one[1:] for one in said[half:]]


def test_trial_lists_do_not_depend_on_outcomes(site: Served) -> None:
    person = site.person(id="lists").walk("test")
    listed = person.ask("GET", "/api/trials/test")["trials"]
    without = [{k: v for k, v in one.items() if k not in ("trial", "movie", "map", "fixation_ms")}
               for one in listed]  # fmt: skip
    assert without == [without[0]] * len(without)
    found = [ADDRESS.fullmatch(one[kind]) for one in listed for kind in ("movie", "map")]
    assert all(found)
    assert len({match[4] for match in found if match}) == len(found)


def test_nothing_reveals_the_seed_of_the_order(site: Served) -> None:
    """With a public list of stimuli and this package, the seed would reveal every outcome."""
    person = site.person(id="seed").walk("test")
    person.ask("GET", "/api/session")
    for phase in PHASES:
        person.ask("GET", f"/api/trials/{phase}")
    person.answer(0)
    with site.store.engine.connect() as connection:
        kept = connection.execute(
            select(SESSIONS.c.order_seed).where(SESSIONS.c.reference == person.state()["reference"])
        )
        seed = kept.scalar_one()
    said = "".join(answer.text for _, answer in person.heard)
    assert "/media/t-" in said and "/media/f-" in said
    order = [one.stimulus for one in trial_order(site.study, "collide", seed)["test"]]
    for written in (str(seed), f"{seed:x}", f"{seed:016x}"):
        assert written not in said
    numbers_said = {int(word) for word in re.findall(r"\d+", said)}
    numbers_said |= {int(word, 16) for word in re.findall(r"[0-9a-f]+", said)}
    numbers_said |= {int(word[2], 16) ^ int((word[3] + word[4])[at : at + 16], 16)
                     for word in ADDRESS.finditer(said) for at in (0, 16, 32)}  # fmt: skip
    assert seed not in numbers_said and len(numbers_said) > 50
    assert all(name not in said for name in order)


def test_media_have_no_file_headers(site: Served) -> None:
    person = site.person(id="headers").walk("test")
    listed = person.ask("GET", "/api/trials/test")["trials"]
    headers = [dict(site.client.get(one["movie"]).headers) for one in listed]
    for one in headers:
        assert not {"etag", "last-modified", "content-disposition", "date"} & set(one)
        del one["content-length"]
    assert headers == [headers[0]] * len(headers)
    assert headers[0]["cache-control"] == "private, max-age=86400, immutable"
    part = site.client.get(listed[0]["movie"], headers={"range": "bytes=0-9"})
    assert part.status_code == 200 and len(part.content) > 10


class TestWholeMovies:
    """The full movie is available only with the feedback."""

    @pytest.fixture
    def listed(self, site: Served) -> dict[str, list[Any]]:
        person = site.person().walk("familiarization")
        return {phase: person.ask("GET", f"/api/trials/{phase}")["trials"] for phase in PHASES}

    @pytest.mark.parametrize("phase", PHASES)
    def test_no_path_becomes_one_by_changing_its_kind(
        self, site: Served, listed: dict[str, list[Any]], phase: str
    ) -> None:
        for one in listed[phase]:
            for kind in ("movie", "map"):
                path = one[kind].replace(f"-{kind}-", "-full-")
                assert site.client.get(path).status_code == 404

    def test_nor_by_any_other_change(self, site: Served, listed: dict[str, list[Any]]) -> None:
        path: str = listed["test"][0]["movie"]
        letter, trial, kind, seed, tag, mac = path.removeprefix("/media/").split("-")
        hidden, others = f"{seed}-{tag}", f"{int(seed, 16) ^ 1:016x}-{tag}"
        other = "0" if mac[0] != "0" else "1"
        start, own = f"{letter}-{trial}-{kind}", f"-{hidden}-{mac}"
        changed = [
            f"f-{trial}-full{own}", f"f-{trial}-{kind}{own}", f"{letter}-1-{kind}{own}",
            f"{letter}-0{trial}-{kind}{own}", f"{letter}-٠-{kind}{own}", f"{start}-",
            f"{start}-{others}-{mac}", f"{start}-{seed}-{'f' * 16}-{mac}",
            f"{start}-{hidden}-{other}{mac[1:]}",
            f"{start}-{mac[:16]}-{mac}", f"{start}-{mac}", f"{start}-{hidden}-{mac.upper()}",
            f"{start}{own}%0a", f"{start}{own}/", f"{start}{own}.mp4",
        ]  # fmt: skip
        for name in changed:
            answer = site.client.get(f"/media/{name}")
            assert answer.status_code == 404, name

    def test_a_test_trial_has_none_even_with_the_key(self, site: Served) -> None:
        words = ("media", site.study.stimuli_digest, "collide", "1", "t-0-full", NO_TAG)
        signature = sign(site.secrets, *words)
        pad = int(sign(site.secrets, "hidden seed", signature)[:16], 16)
        path = f"/media/t-0-full-{1 ^ pad:016x}-{NO_TAG}-{signature}"
        assert site.client.get(path).status_code == 404
        with pytest.raises(ValueError, match="test trial"):
            sign_media(site.study, site.secrets, "collide", 1, "test", 0, "full")

    def test_it_comes_with_the_feedback(self, site: Served) -> None:
        person = site.person().walk("familiarization")
        feedback = person.answer(0, "familiarization")["feedback"]
        movie = site.client.get(feedback["movie"]).content
        assert numbers(movie) == list(range(FULL))

    def test_a_shared_path_shows_only_the_observed_movie(self, site: Served) -> None:
        """A shared path shows only observed frames and reveals nothing about a session."""
        person = site.person().walk("test")
        movie = person.ask("GET", "/api/trials/test")["trials"][0]["movie"]
        stranger = site.client.get(movie, headers={"authorization": "Bearer nobody"})
        assert numbers(stranger.content) == list(range(OBSERVED))


def test_the_study_folder_is_not_served(site: Served) -> None:
    stimulus: Stimulus = site.study.stimuli[0]
    names = ["stimuli.csv", "study.toml", "secret.json", "responses.sqlite", "texts/en.toml",
             stimulus.movie, stimulus.map, stimulus.full]  # fmt: skip
    for name in names:
        assert (site.study.folder / name).is_file()
        for place in ("/", "/static/", "/media/", "/api/"):
            answer = site.client.get(place + name, follow_redirects=False)
            assert answer.status_code == 404, place + name
        hidden = site.client.get(f"/experimenter/static/{name}", follow_redirects=False)
        assert hidden.status_code in (303, 404)
    for name in ("wire.py", "store.py", "texts/en.toml", "pages/index.html"):
        assert site.client.get(f"/static/{name}").status_code == 404


def test_the_search_itself_finds_what_it_looks_for(site: Served) -> None:
    """Check that the search itself would find a leak."""
    name = site.study.stimuli[0].stimulus
    answer = site.client.get("/api/health")
    answer._content = json.dumps({"trials": [{"x": name, "label": False}]}).encode()
    with pytest.raises(AssertionError):
        assert_silent(site, answer)
    assert dict(telling(answer.json())) == {"label": False}
    full = (site.study.folder / site.study.stimuli[0].full).read_bytes()
    assert numbers(full)[-1] == FULL - 1
