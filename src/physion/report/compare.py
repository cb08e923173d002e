"""Comparison of models with people, from Python objects or files: `compare` and its result.

It stands above the analysis, which computes the tables, and the report, which draws them, so that
a result can write its own report.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd

from physion.analysis.check import (
    Checked,
    Reference,
    check_predictions_file,
    check_responses,
    read_index,
)
from physion.analysis.compare import all_results, tidy_scores
from physion.analysis.comparison import NOT_PREDICTED, check_coverage
from physion.analysis.intervals import LEVEL, Bootstrap
from physion.analysis.model_tests import fits_of_people
from physion.analysis.people.exclusions import Expected, find_expected, read_expected
from physion.analysis.people.responses import Participants, check_labels, keep_where
from physion.analysis.people.results import (
    PeopleResults,
    analyse_people,
    read_any_responses,
    read_attributes,
    rules_called,
)
from physion.analysis.population import PopulationResults
from physion.analysis.published.tables import PublishedTables, read_published
from physion.analysis.results import (
    SEEN,
    frames_with_benchmark,
    published_rows,
    results_table,
    says_frames,
    scenarios_of_rows,
    zone_of_people,
)
from physion.analysis.rollout_errors import read_rollout_errors, rollout_error_table
from physion.analysis.scores import AVERAGES, shown_average
from physion.analysis.tables import (
    LABELS_FILE,
    MEAN,
    POOLED,
    PREDICTIONS,
    DominoesLook,
    check_excluded_names,
    check_predictions,
    find_next_to,
    in_order,
    join_predictions,
    read_human_zone,
    read_humans,
    read_labels,
    read_stimulus_list,
)
from physion.compute.tasks import Progress
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import SCENARIOS, canonical_name
from physion.core.tables import (
    inspect_table,
    read_csv,
    read_table,
    refuse_duplicates,
    require_columns,
)
from physion.data.official import PACKAGED, find_official, official
from physion.report.build import build_people_report, build_report
from physion.report.html import MACROS, plural
from physion.report.inputs import PeopleReport, ReportInputs
from physion.report.people import describe_attributes
from physion.tasks.logs import is_log, read_answers

ZONE_FILE = "human_accuracy_by_scenario.csv"

Predictions: TypeAlias = Mapping[str, Mapping[str, float]] | pd.DataFrame | Path | str
"""P(contact) by model and stimulus; a table of `physion.analysis.tables.PREDICTIONS`; its CSV file;
or a log of answers of a language model (`physion.tasks.logs`)."""

_LOOKS = {
    "plain": "those who saw free colours with flashing overlays, as in the paper",
    "redyellow": "those who saw a red agent and a yellow patient",
    "pooled": "people of both looks, weighted by their number",
}


INTERVALS = "; 95 % intervals"
"""End of the heading of a table of results with intervals."""


@dataclass(frozen=True)
class CompareResult:
    """Result of `compare`.

    - ``scores``: one row per model (people first, baselines last) and scenario, then `MEAN` over
      scenarios with equal weights and `POOLED` over all stimuli. Columns: ``model``, ``kind``
      (people, model, baseline), ``base_model``, ``readout``, ``scenario``, ``stimuli``, every
      metric with its 95 % interval (``accuracy``, ``accuracy_low``, ``accuracy_high``, ``r``, ...),
      ``ceiling`` of r, and ``reason`` of what is undefined. ``kappa`` is that with single
      participants; it needs their answers.
    - ``people``: the analysis of single participants; None without their answers.
    - ``inputs``: all that a report shows.
    """

    scores: pd.DataFrame
    people: PeopleResults | None
    inputs: ReportInputs | PeopleReport

    @property
    def warnings(self) -> tuple[str, ...]:
        """What may make the results wrong, one sentence each."""
        if isinstance(self.inputs, PeopleReport):
            return self.inputs.people.warnings
        return self.inputs.warnings

    @property
    def population(self) -> PopulationResults | None:
        """Consensus, agreement and differences of populations; None if not asked for."""
        return None if isinstance(self.inputs, PeopleReport) else self.inputs.population

    @property
    def notes(self) -> tuple[str, ...]:
        """How many stimuli are left out, and which ended otherwise when simulated than recorded."""
        if isinstance(self.inputs, PeopleReport):
            return ()
        comparison = self.inputs.comparison
        dropped = comparison.dropped
        given = dropped[(dropped["model"] != "") & (dropped["reason"] != NOT_PREDICTED)]
        # Over the scenarios of a model; of several models the largest number counts.
        by_model = given.groupby(["model", "reason"], sort=False)["stimuli"].sum()
        counts = by_model.groupby("reason", sort=False).max()
        notes = [f"{plural(n, 'stimulus')} left out: {reason}" for reason, n in counts.items()]
        if len(comparison.changed):
            names, shown = list(comparison.changed["stimulus"]), 5
            more = f" and {len(names) - shown} more" if len(names) > shown else ""
            notes.append(
                f"{len(names)} of {comparison.stimuli['stimulus'].nunique()} stimuli ended "
                "otherwise in a simulation than recorded; the recorded outcome counts: "
                f"{', '.join(names[:shown])}{more} (tables/changed_outcomes.csv)"
            )
        return tuple(notes)

    @property
    def results(self) -> pd.DataFrame:
        """The table of results: people first, then all others by accuracy (`results_table`).

        Over the scenarios with equal weights or, where that has no number because scenarios have
        too few stimuli, over all stimuli together.
        """
        if isinstance(self.inputs, PeopleReport):
            return results_table(self.scores)
        return self.inputs.results()

    @property
    def summary(self) -> pd.DataFrame:
        """The table of results with accuracy, r and kappa as text with their intervals."""
        return as_text(self.results)

    @property
    def summary_of(self) -> str:
        """Scenario of the rows of ``summary``, from `shown_average`."""
        return shown_average(self.scores)

    def report(self, folder: Path | str, **page: Any) -> Path:
        """Write page, tables and figures to ``folder``; return the path of the page.

        Parameters
        ----------
        folder
            Folder for ``report.html``, ``report.json``, ``tables/`` and ``figures/``.
        **page
            Fields of `ReportInputs` such as ``movies``, ``title`` and ``methods``, which are added
            to the comparison's.

        Raises
        ------
        BadInputError
            Before anything is written, if ``folder`` is a file or a movie cannot be read.
        """
        known = [one.name for one in fields(ReportInputs)]
        for name in page:
            if name not in known:
                raise UnknownNameError("field of the report", name, known)
        methods = {**self.inputs.methods, **page.pop("methods", {})}
        if isinstance(self.inputs, PeopleReport):
            for name in set(page) - {"movies", "title"}:
                raise BadInputError(f"{name} is about predictions: give some")
            return build_people_report(replace(self.inputs, methods=methods, **page), Path(folder))
        return build_report(replace(self.inputs, methods=methods, **page), Path(folder))

    def __repr__(self) -> str:
        return f"{self.heading}\n{self._own().to_string(index=False)}"

    def _repr_html_(self) -> str:
        own = self._own()
        return str(
            MACROS.table(list(own), [("", own.astype(str).to_numpy().tolist())], self.heading)
        )

    def _own(self) -> pd.DataFrame:
        """Return `summary` without what others published."""
        results = self.results
        return as_text(results[results["source"] == ""])

    @property
    def heading(self) -> str:
        """What the table of results is about: scenarios, average, stimuli, intervals."""
        rows = self.scores
        names = [name for name in rows["scenario"].unique() if name not in (MEAN, POOLED)]
        of = "8 scenarios" if set(names) == set(SCENARIOS) else ", ".join(names)
        counts = rows.loc[rows["scenario"] == self.summary_of, "stimuli"]
        each = f"; {counts.iloc[0]} stimuli" if counts.nunique() == 1 else ""
        return f"{of}; {AVERAGES[self.summary_of]}{each}{INTERVALS}"


def as_text(results: pd.DataFrame, *, intervals: bool = True) -> pd.DataFrame:
    """Return a table of results (`results_table`) for a terminal.

    Columns: ``model``, ``given``, ``frames`` with the benchmark, ``check``, ``stimuli`` and
    ``scenarios`` where their number differs, and ``accuracy``, ``r with people`` and ``kappa`` with
    their intervals, if these are wanted, as far as they are known.
    """
    table = results[["row"]].set_axis(["model"], axis=1)
    if (results["given"] != "").any():
        table["given"] = results["given"]
    if says_frames(results):
        table["frames"] = frames_with_benchmark(results)
    if (results["check"] != "").any():
        table["check"] = results["check"]
    if results["stimuli"].nunique() > 1:
        table["stimuli"] = results["stimuli"].astype("Int64")
    if partial := scenarios_of_rows(results):
        table["scenarios"] = partial
    for heading, name in (("accuracy", "accuracy"), ("r with people", "r"), ("kappa", "kappa")):
        if results[name].notna().any():
            kept = results if intervals else results.drop(columns=[f"{name}_low", f"{name}_high"])
            table[heading] = [with_interval(row, name) for _, row in kept.iterrows()]
    return table.reset_index(drop=True)


def with_interval(row: pd.Series, name: str) -> str:
    """Return a number with its interval as text; empty if it is undefined."""
    value, low, high = row[name], row.get(f"{name}_low"), row.get(f"{name}_high")
    if pd.isna(value):
        return ""
    return f"{value:.3f}" + ("" if pd.isna(low) else f" [{low:.3f}, {high:.3f}]")


def population_tables(results: PopulationResults) -> dict[str, pd.DataFrame]:
    """Return consensus and agreement in the mean over scenarios, and differences by scenario.

    Numbers are texts with their intervals; the keys are titles.
    """
    consensus, agreement = (
        t[t["scenario"] == MEAN] for t in (results.consensus, results.agreement)
    )
    first = consensus[["population", "members", "ties", "stimuli"]].assign(
        **_texts(consensus, {"accuracy of the consensus": "consensus", "of a member": "member"}),
        **{"SD of members": consensus["member_sd"]},
    )
    kappas = {"kappa of members": "kappa_members", "kappa of majorities": "kappa_majorities"}
    apart = {"members disagree": "disagreement_members",
             "majorities disagree": "disagreement_majorities"}  # fmt: skip
    second = agreement[["first", "second"]].assign(**_texts(agreement, kappas | apart))
    tables = {
        "Populations: mean over scenarios; 95 % intervals over stimuli": first,
        "Two members, and two majorities (of one population: of its halves)": second,
    }
    if len(results.differences):
        names = {"of the consensus": "consensus", "of a member": "member"}
        tables["Accuracy less people's"] = results.differences[
            ["population", "scenario", "stimuli"]
        ].assign(**_texts(results.differences, names))
    return tables


def _texts(table: pd.DataFrame, columns: Mapping[str, str]) -> dict[str, list[str]]:
    """Return columns of a table with their intervals as texts, by heading."""
    return {
        heading: [with_interval(row, name) for _, row in table.iterrows()]
        for heading, name in columns.items()
    }


def check_files(
    predictions: Sequence[Path] = (),
    *,
    humans: Path | None = None,
    responses: Sequence[Path] = (),
    labels: Path | None = None,
    sessions: Path | None = None,
    rules: str | None = None,
    expected: Path | None = None,
    dataset: Path | None = None,
    fitted: Path | None = None,
) -> list[Checked]:
    """Check files before a comparison: the responses, then each file of predictions.

    Parameters
    ----------
    predictions, humans, responses, labels, sessions, rules, expected
        As in `compare`. Outcomes of the responses serve where no others are given. By default
        stimuli of the original study need not all be predicted.
    dataset
        Dataset of the trials: no predicted one may be in another split.
    fitted
        List of the stimuli on which the readout was fitted.

    Returns
    -------
    checked
        Every fault with its row, by file.

    Raises
    ------
    BadInputError
        If there is nothing to check, or a file is not a table.
    """
    if not predictions and not responses:
        raise BadInputError("nothing to check: give files of predictions, or --responses")
    outcomes = read_outcomes(labels)
    if outcomes is None and humans is not None:
        _, outcomes, _, _ = read_averages(humans)
        if outcomes is None:
            raise BadInputError(f"no {LABELS_FILE} lies near {humans}; give --labels")
    found = []
    index = None if dataset is None else read_index(dataset)
    known = None if fitted is None else read_stimulus_list(fitted)
    if responses:
        path = expected or find_expected(responses)
        checked, read = check_responses(
            responses,
            sessions,
            outcomes,
            None if path is None else read_expected(path),
            rules_called(rules, responses),
        )
        found.append(checked)
        if outcomes is None and read is not None and len(read.test):
            rows = read.test.drop_duplicates("stimulus")
            outcomes = dict(zip(rows["stimulus"], rows["label"].astype(bool), strict=True))
    by_default = outcomes is None and not responses and _are_of_study(predictions, index)
    if by_default:
        outcomes = dict(official().labels)
    reference = Reference(outcomes, index, known, complete=not by_default)
    return [*found, *(check_predictions_file(path, reference) for path in predictions)]


def _are_of_study(paths: Sequence[Path], index: pd.DataFrame | None) -> bool:
    """Return whether files of predictions are compared with the people of the original study.

    So are, as in `compare`, those that name one of its stimuli. Those that neither state outcomes
    nor are of a dataset (``index``) must be, since they are compared with nothing else.
    """
    tables = [inspect_table(read_csv(path), PREDICTIONS)[0] for path in paths]
    rows = pd.concat(tables).reindex(columns=["stimulus", "outcome", "recorded_outcome"])
    if not official().labels.keys().isdisjoint(rows["stimulus"].astype(str).map(canonical_name)):
        return True
    return index is None and bool(rows[["outcome", "recorded_outcome"]].isna().all(axis=None))


def compare(
    predictions: Predictions | Sequence[Predictions] = (),
    *,
    humans: str | Path | pd.DataFrame | None = None,
    responses: str | Path | Sequence[str | Path] = (),
    labels: str | Path | Mapping[str, bool] | None = None,
    sessions: Path | None = None,
    rules: str | None = None,
    expected: Path | Expected | None = None,
    simulated: bool = False,
    where: Sequence[str] = (),
    attributes: Path | pd.DataFrame | None = None,
    groups: Sequence[str | Path | pd.DataFrame] = (),
    population: bool = False,
    exclude: Path | Iterable[str] = (),
    ledge: bool = False,
    dominoes: DominoesLook = "plain",
    zone: Path | None = None,
    rollout_errors: Sequence[Path] = (),
    resamples: int = 1000,
    seed: int = 0,
    progress: Progress | None = None,
) -> CompareResult:
    """Compare models with people: accuracy, correlation, kappa, each with its interval.

    Parameters
    ----------
    predictions
        P(contact) by model and stimulus, tables, CSV files, logs of answers of language models
        (``.eval`` of Inspect, samples of lmms-eval), or several of these. A table needs the columns
        ``stimulus`` and ``p_contact`` only; `physion.analysis.tables.PREDICTIONS` has the others.
        None: an analysis of the people in ``responses``.
    humans
        Averages of people: ``official`` for the shipped ones, a folder of
        ``human_accuracy-*.csv``, or a table with ``stimulus``, ``scenario``, ``accuracy`` and
        ``count``. None: ``official`` if the predictions name stimuli of the original study and
        there are no ``labels`` but the official ones, else nobody.
    responses
        Answers of single participants in place of ``humans``: the file of our export, or the
        study's raw files.
    labels
        Outcome by stimulus, its table (``stimulus``, ``contact``), or ``official``. None: as in the
        people's table; for stimuli without one ``recorded_outcome`` of the predictions.
    sessions
        Table of sessions of our export, with ``responses``.
    rules
        Name of the exclusion rules: ``preregistered``, ``preregistered-only`` (without what the
        experiment's server found) or ``official-code``. None: those in ``study.json`` next to the
        responses, else ``preregistered``.
    expected
        Stimuli that a session must have, by scenario, or their table. None:
        ``expected.csv`` next to the responses, else the stimuli that half of the scenario's
        sessions answered.
    simulated
        Whether to rehearse with the simulated participants of ``responses``, who are left out
        otherwise.
    where
        Values that the sessions must have, such as ``condition=fast``.
    attributes
        Elements, distractors and occluders of one's own stimuli: a table, its file, or a dataset.
    groups
        What groups of models are compared by: columns of the predictions, and tables (or their CSV
        files) with ``model`` and any further columns, all of which count.
    population
        Whether seeds or checkpoints of a model are compared with people as one population
        (`CompareResult.population`).
    exclude
        Stimuli to exclude, or a file with one per line.
    ledge
        Whether to keep the Roll stimuli with a ledge, which the study excluded.
    dominoes
        Which people count for Dominoes in ``humans``.
    zone
        Official table of participants' percentiles; None: looked for next to ``humans``.
    rollout_errors
        Files of ``physion evaluate --option rollout_errors=true``, for a figure of them.
    resamples, seed
        Draws of people for their accuracy and agreement, of halves, and of permutations.
    progress
        Shows the progress of the mixed models of people, which take minutes for a large study.

    Returns
    -------
    result
        The scores as one table, and all that a report shows.

    Raises
    ------
    BadInputError
        For a table that is not complete, or tables that contradict each other.

    Examples
    --------
    >>> import physion
    >>> p = {name: 0.9 if contact else 0.2 for name, contact in physion.official().labels.items()}
    >>> result = physion.compare({"nearly right": p}, humans="official")
    >>> float(result.scores.query("scenario == 'mean' and kind == 'model'")["accuracy"].iloc[0])
    1.0
    """
    draws = Bootstrap(resamples, seed=seed)
    rows, grouped, missing = _rows(predictions, groups)
    files = [Path(responses)] if isinstance(responses, str | Path) else [*map(Path, responses)]
    if rows is None and not files:
        raise BadInputError(
            "no predictions: give some, or responses for an analysis of people (--responses)"
        )
    if rows is None and (rollout_errors or groups or population):
        what = "rollout errors" if rollout_errors else "groups and populations of models"
        raise BadInputError(f"{what} are about predictions: give some")
    errors = read_rollout_errors(rollout_errors) if rollout_errors else None
    excluded = read_stimulus_list(exclude) if isinstance(exclude, Path) else list(exclude)
    settings: dict[str, Any] = {
        "exclude": excluded,
        "exclude_ledge": not ledge,
        "bootstrap": draws,
    }
    asked: dict[str, Any] = {"groups": grouped, "population": population}
    if files:
        if humans is not None:
            raise BadInputError("give averages of people (humans) or their responses, not both")
        if zone is not None or dominoes != "plain":
            raise BadInputError(
                "zone and dominoes are about averages of people; responses have a zone of their "
                "own, and --where look=redyellow chooses a look"
            )
        people, methods = _participants(
            files, sessions, rules, labels, expected, simulated, where, attributes,
            settings,
        )  # fmt: skip
        if rows is None:
            check_excluded_names(excluded, people.stimuli)
            methods |= {"Intervals": _describe_intervals(draws)}
            fits = tuple(fits_of_people(people, progress))
            page = PeopleReport(people, fits, methods)
            return CompareResult(_scores_of_people(people), people, page)
        results = all_results(rows, people=people, progress=progress, **asked, **settings)
    else:
        assert rows is not None
        about = (sessions, rules, expected, attributes)
        if any(one is not None for one in about) or simulated or where:
            raise BadInputError(
                "sessions, rules, expected, attributes, chosen values (where) and "
                "simulated participants are about responses: give those"
            )
        if humans is None and not isinstance(labels, Mapping):
            study = official() if labels is None else find_official(labels)
            of_study = study and not study.labels.keys().isdisjoint(rows["stimulus"])
            humans = (labels or PACKAGED) if of_study else None
            stated = rows[["outcome", "recorded_outcome"]].notna().any(axis=None)
            if study and not of_study and not stated:
                raise BadInputError(
                    f"{_not_of_study(rows)}; correct the names, or give stimuli of your own a "
                    "column scenario, and a column outcome or the labels (--labels)"
                )
        if not isinstance(humans, pd.DataFrame | None) and find_official(humans) is not None:
            missing += filter(None, [_not_of_study(rows)])
        averages = _averages(rows, humans, labels, zone, dominoes)
        methods = dict(averages.methods)
        results = all_results(
            rows, averages.people, averages.labels, zone=averages.zone,
            zone_origin=averages.zone_origin, **asked, **settings,
        )  # fmt: skip
        results = replace(results, warnings=(*results.warnings, *averages.warnings))
    results = replace(results, warnings=(*results.warnings, *missing))
    tables, scenarios = None, in_order(results.comparison.stimuli["scenario"])
    if results.comparison.has_people and set(scenarios) <= set(SCENARIOS) and not files:
        tables = _published_of(results.comparison.stimuli["stimulus"])
    inputs = ReportInputs.of(
        results,
        methods=methods,
        published=None if tables is None else published_rows(tables, scenarios),
        zone=None if tables is None else zone_of_people(tables, scenarios),
        model_inputs=_by_model(rows, "inputs"),
        model_seen=_seen(rows),
        model_weights=_by_model(rows, "init"),
        rollout_errors=None if errors is None else rollout_error_table(errors),
    )
    return CompareResult(tidy_scores(results), results.people, inputs)


def _not_of_study(rows: pd.DataFrame) -> str:
    """Return how many predicted stimuli are not the study's, and the closest name to the first.

    Empty if all are.
    """
    names, known = rows["stimulus"].unique(), official().labels
    unknown = [str(name) for name in names if name not in known]
    if not unknown:
        return ""
    close = get_close_matches(unknown[0], known, n=1)
    hint = f" (closest: {close[0]!r})" if close else ""
    are = "is no stimulus" if len(unknown) == 1 else "are no stimuli"
    return (
        f"{len(unknown)} of {plural(len(names), 'predicted name')} {are} of the study, such as "
        f"{unknown[0]!r}{hint}"
    )


def _published_of(stimuli: pd.Series) -> PublishedTables | None:
    """Return the released tables of the study if all stimuli are the study's."""
    return _released() if set(stimuli) <= set(official().labels) else None


@cache
def _released() -> PublishedTables:
    return read_published(official().results.parent)


def _rows(
    predictions: Predictions | Sequence[Predictions],
    groups: Sequence[str | Path | pd.DataFrame],
) -> tuple[pd.DataFrame | None, list[str], list[str]]:
    """Return all predictions as one table, the columns of groups, and warnings of logs.

    Names of models are unique. The table is None if there is none.
    """
    if isinstance(predictions, Mapping | pd.DataFrame | Path | str):
        given: Sequence[Predictions] = [predictions]
    else:
        given = predictions
    tables, raw, warnings = [], [], list[str]()
    for one in given:
        if isinstance(one, Mapping):
            for model, values in one.items():
                columns = {"stimulus": list(values), "p_contact": list(values.values())}
                raw.append(pd.DataFrame(columns))
                tables.append((model, check_predictions(raw[-1], model, model)))
        elif isinstance(one, pd.DataFrame):
            raw.append(one)
            tables.append(("a table", check_predictions(one)))
        else:
            path = Path(one)
            if is_log(path):
                log = read_answers(path)
                raw.append(log.predictions)
                warnings += log.warnings
            else:
                raw.append(read_csv(path))
            tables.append((str(path), check_predictions(raw[-1], str(path), path.stem)))
    if not tables:
        return None, [], []
    return *_with_groups(join_predictions(tables), raw, groups), warnings


def _with_groups(
    rows: pd.DataFrame, raw: Sequence[pd.DataFrame], groups: Sequence[str | Path | pd.DataFrame]
) -> tuple[pd.DataFrame, list[str]]:
    """Return named predictions with the columns of groups as text, and their names.

    ``raw``: the tables that the rows were read from, in their order.
    """
    extra = pd.concat(raw, ignore_index=True) if groups else pd.DataFrame()
    names = []
    for group in groups:
        if isinstance(group, pd.DataFrame) or Path(group).suffix in (".csv", ".parquet"):
            table = group if isinstance(group, pd.DataFrame) else read_table(Path(group), ["model"])
            require_columns(table, ["model"], "the table of groups")
            refuse_duplicates(table["model"], "the table of groups")
            own = table.set_index("model")
            for name in own:
                by_name = rows["model"].map(own[name])
                rows = rows.assign(**{name: by_name.fillna(rows["base_model"].map(own[name]))})
            names += list(own)
        elif str(group) in rows:
            names.append(str(group))
        elif str(group) in extra:
            rows = rows.assign(**{str(group): extra[str(group)].to_numpy()})
            names.append(str(group))
        else:
            raise UnknownNameError("column of the predictions", str(group), [*extra, *rows])
    return rows.assign(**{n: rows[n].fillna("").astype(str) for n in names}), names


def _by_model(rows: pd.DataFrame, column: str) -> dict[str, str]:
    """Return a column of the predictions by model; several values are joined by ``or``."""
    given = rows[rows[column] != ""]
    pairs = given[["base_model", column]].drop_duplicates()
    return {
        str(model): " or ".join(values) for model, values in pairs.groupby("base_model")[column]
    }


def _seen(rows: pd.DataFrame) -> pd.DataFrame:
    """Return columns `SEEN` by model; frames of several scenarios are joined by ``or``."""
    return rows.groupby("model", sort=False)[list(SEEN)].agg(
        lambda values: " or ".join(filter(None, dict.fromkeys(values)))
    )


@dataclass(frozen=True)
class Averages:
    """Averages of people by stimulus (None: no people), outcomes, zones, and where they are from.

    ``labels``: outcome by stimulus; ``zone``: see `read_human_zone`; ``methods``: the sources as
    text by name; ``warnings``: what the tables lack.
    """

    people: pd.DataFrame | None
    labels: Mapping[str, bool] | None = None
    zone: pd.DataFrame | None = None
    zone_origin: str = ""
    methods: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def _averages(
    rows: pd.DataFrame,
    humans: str | Path | pd.DataFrame | None,
    labels: str | Path | Mapping[str, bool] | None,
    zone: Path | None,
    dominoes: DominoesLook,
) -> Averages:
    """Return averages of people, their outcomes and their zone."""
    if humans is None:
        return Averages(None, read_outcomes(labels))
    averages, known, origin, zone_file = read_averages(humans, labels, dominoes)
    if known is None and rows["recorded_outcome"].isna().all():
        raise BadInputError(f"no {LABELS_FILE} lies near {humans}; give the labels (--labels)")
    zone = zone_file if zone is None else zone
    zone_table = None if zone is None else read_human_zone(zone)
    zone_origin = "" if zone is None else f"official table {zone.name}"
    warnings = []
    # Outcomes that were given as values may be of more stimuli than people saw.
    if known and not isinstance(labels, Mapping):
        warnings += check_coverage(averages, known)
    if zone_table is not None:
        absent = set(averages["scenario"]) - set(zone_table["scenario"])
        warnings += [f"{name}: {zone_origin} has no row: is it cut?" for name in in_order(absent)]
    methods = {"Official outcomes": origin, "People for Dominoes": _LOOKS[dominoes]}
    return Averages(averages, known, zone_table, zone_origin, methods, tuple(warnings))


def read_averages(
    humans: str | Path | pd.DataFrame,
    labels: str | Path | Mapping[str, bool] | None = None,
    dominoes: DominoesLook = "plain",
) -> tuple[pd.DataFrame, dict[str, bool] | None, str, Path | None]:
    """Return answers of people by stimulus, the outcomes with their source, and a file of zones.

    ``humans`` and ``labels`` as in `compare`. The outcomes are None if none are known, and
    the file is None if there is none.
    """
    known, origin = read_outcomes(labels), "those recorded with the trials"
    if isinstance(labels, str | Path):
        origin = Path(labels).name
    if isinstance(humans, pd.DataFrame):
        require_columns(humans, ("stimulus", "scenario", "accuracy", "count"), "the averages")
        return humans, known, origin, None
    data = find_official(humans)
    folder = Path(humans) if data is None else data.humans
    if known is None:
        file = find_next_to(folder, "stimuli", LABELS_FILE)
        if file is not None:
            known, origin = read_labels(file), file.name
        elif data is not None:
            known, origin = dict(data.labels), "the study's outcomes"
    zone = find_next_to(folder, "results", ZONE_FILE)
    return read_humans(folder, dominoes), known, origin, zone


def read_outcomes(labels: str | Path | Mapping[str, bool] | None) -> dict[str, bool] | None:
    """Return outcomes by stimulus from a table, or the study's for ``official``."""
    if labels is None or isinstance(labels, Mapping):
        return None if labels is None else dict(labels)
    data = find_official(labels)
    return read_labels(Path(labels)) if data is None else dict(data.labels)


def _participants(
    files: Sequence[Path],
    sessions: Path | None,
    rules: str | None,
    labels: str | Path | Mapping[str, bool] | None,
    expected: Path | Expected | None,
    simulated: bool,
    where: Sequence[str],
    attributes: Path | pd.DataFrame | None,
    settings: Mapping[str, Any],
) -> tuple[PeopleResults, dict[str, str]]:
    """Return the analysis of single participants, and its settings as text."""
    expected = find_expected(files) if expected is None else expected
    people = _read_people(
        files, sessions, rules, read_outcomes(labels), settings["exclude"],
        settings["exclude_ledge"], settings["bootstrap"],
        expected=read_expected(expected) if isinstance(expected, Path) else expected,
        participants="simulated" if simulated else "people",
        attributes=read_attributes(attributes) if isinstance(attributes, Path) else attributes,
        where=where,
    )  # fmt: skip
    chosen = f"; of the sessions with {', '.join(where)} only" if where else ""
    return people, {
        "Official outcomes": "those recorded with the responses",
        "People": _describe_people(files, people) + chosen,
        "Trials of a whole session": _describe_expected(people, expected is not None),
        "Attributes of stimuli": describe_attributes(people),
    }


_PEOPLE_COLUMNS = ("model", "kind", "base_model", "readout", "scenario", "stimuli", "accuracy",
                   "accuracy_low", "accuracy_high")  # fmt: skip


def _scores_of_people(people: PeopleResults) -> pd.DataFrame:
    """Return accuracy of people by scenario with the columns of `CompareResult.scores`."""
    rows = people.tables["by_scenario"]
    return pd.DataFrame(
        {
            "model": "people",
            "kind": "people",
            "scenario": rows["scenario"],
            "stimuli": rows["stimuli"],
            "accuracy": rows["accuracy"],
            "accuracy_low": rows["accuracy_low"],
            "accuracy_high": rows["accuracy_high"],
        }
    ).reindex(columns=[*_PEOPLE_COLUMNS, "r", "kappa", "kappa_from_averages"])


def _read_people(
    responses: Sequence[Path],
    sessions: Path | None,
    rules: str | None,
    labels: Mapping[str, bool] | None,
    excluded: list[str],
    exclude_ledge: bool,
    draws: Bootstrap,
    *,
    expected: Expected | None = None,
    participants: Participants = "people",
    attributes: pd.DataFrame | None = None,
    where: Sequence[str] = (),
) -> PeopleResults:
    """Read responses and run every analysis of people."""
    chosen = rules_called(rules, responses)
    read = keep_where(read_any_responses(responses, sessions, participants), where)
    if labels is not None:
        check_labels(read, labels)
    return analyse_people(
        read,
        rules=chosen,
        expected=expected,
        attributes=attributes,
        exclude=excluded,
        exclude_ledge=exclude_ledge,
        bootstrap=draws,
    )


def _describe_people(responses: Sequence[Path], people: PeopleResults) -> str:
    """Describe the responses and the flagged sessions."""
    flags = people.tables["flags"]
    kind = "simulated" if people.mark else "single"
    return (
        f"answers of {kind} participants from {', '.join(path.name for path in responses)}: "
        f"{len(flags)} sessions, {int(flags['flagged'].sum())} of them flagged by the rules "
        f"“{people.rules.name}” and left out of the main analysis"
    )


def _describe_expected(people: PeopleResults, given: bool) -> str:
    """Describe how many stimuli a session must have, and how many sessions lack some."""
    flags = people.tables["flags"]
    counts = flags.groupby("scenario")["expected"].first()
    each = ", ".join(f"{name} {count}" for name, count in counts.items())
    by = (
        "by the study's list"
        if given
        else "stimuli that at least half of the scenario's sessions answered"
    )
    return f"{by}: {each}; {plural(int(flags['incomplete'].sum()), 'session')} lacked some"


def _describe_intervals(draws: Bootstrap) -> str:
    """Describe the intervals of results about people."""
    return (
        f"{LEVEL:.0%} percentile bootstrap, people drawn within each scenario, "
        f"{draws.resamples} resamples, seed {draws.seed}"
    )
