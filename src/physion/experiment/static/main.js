/**
 * Entry point of the page: load study and texts, check the device, enter, run the session.
 * @module main
 */

import { AnswerQueue } from "./answer_queue.js";
import { Api, Refused } from "./api.js";
import { completionParts } from "./ending_pages.js";
import { anotherPerson, cameWithoutId, enter, readArrival } from "./entering.js";
import { EventLog } from "./event_log.js";
import { Frame } from "./frame.js";
import { deviceProblem } from "./gate.js";
import { patiently, showPage } from "./page_trial.js";
import { messagePage, openingPage } from "./pages.js";
import { Session } from "./session.js";
import { keep, recall, takeOver } from "./storage.js";
import { bound, chooseLanguage, offeredLanguage, Texts } from "./texts.js";

/** @typedef {import("./session.js").Basis} Basis */

/** Load the page and start the session. */
async function begin() {
  const address = window.location.href;
  const api = new Api((trouble) => frame?.connection(trouble));
  /** @type {Frame|null} */
  let frame = null;
  const study = await api.get("/api/study");
  const arrival = readArrival(window.location.search, study.recruiters);
  const language = chooseLanguage(study.languages, [arrival.language, recall("language")]);
  const texts = await loadTexts(api, language);
  frame = new Frame(study, texts);
  /** @type {Basis} */
  const basis = { api, texts, study, frame, address, log: new EventLog(api) };
  window.addEventListener("pageshow", (event) => event.persisted && window.location.reload());
  const problem = deviceProblem(study);
  if (problem) {
    const completion = study.device_refused[arrival.enter.source] ?? null;
    return refuse(basis, problem, { completion });
  }
  if (arrival.preview) return showMessage(basis, "information");
  return takePart(basis, arrival);
}

/**
 * Enter and run the session; show refusals.
 * @param {Basis} basis
 * @param {import("./entering.js").Arrival} arrival
 */
async function takePart(basis, arrival) {
  const { api, frame, log } = basis;
  /** @type {Session|null} */
  let session = null;
  const queue = new AnswerQueue(api, (error) => session?.refused(error));
  takeOver(() => {
    if (session) session.close();
    else queue.close();
    log.add("other_tab");
    log.send();
    showMessage(basis, "tabs", { label: "tabs.here", run: () => window.location.reload() });
  });
  queue.load();
  await queue.empty();
  try {
    let state = await patiently(frame.main, openingPage(basis), enter(basis, arrival));
    if (queue.enter(api.token, state.reference)) {
      await queue.empty();
      state = await api.get("/api/session");
    }
    const wanted = [arrival.language, recall("language")];
    const chosen = wanted.some((tag) => offeredLanguage(basis.study.languages, tag));
    if (!chosen) await setLanguage(basis, state.language);
    basis.setLanguage = (language) => setLanguage(basis, language);
    basis.another = cameWithoutId() ? anotherPerson(basis.study, arrival) : null;
    if (state.stage !== "consent") log.begin();
    session = new Session(basis, queue);
    frame.onStop = () => session.askToStop();
    frame.onLanguage = (language) => changeLanguage(basis, session, language);
    await session.run(state);
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    const leave = error.code === "already_took_part" || !cameWithoutId();
    const another = leave ? anotherPerson(basis.study, arrival) : null;
    const { message, completion } = error;
    refuse(basis, error.code, { message, completion, another });
  }
}

/** Change the language as the participant chose. */
async function changeLanguage(basis, session, language) {
  basis.log.add("language", { language });
  keep("language", language);
  await setLanguage(basis, language);
  session.restart();
}

/**
 * Load the texts of a language; keep the current one if the study no longer has it.
 * @param {Basis} basis
 * @param {string} language
 */
async function setLanguage(basis, language) {
  if (language === basis.texts.language) return;
  const { scenario, condition } = basis.texts;
  try {
    basis.texts = await loadTexts(basis.api, language);
    basis.texts.scenario = scenario;
    basis.texts.condition = condition;
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    basis.log.add("no_texts", { language });
    return;
  }
  basis.frame.setTexts(basis.texts);
}

async function loadTexts(api, language) {
  return new Texts(language, await api.get(`/api/texts/${encodeURIComponent(language)}`));
}

/** Show a page with only a message: title and text of a table of the texts. */
function showMessage({ texts, frame }, name, action = null) {
  const [title, text] = [texts.t(`${name}.title`), texts.t(`${name}.text`)];
  const labelled = action && { label: texts.t(action.label), run: action.run };
  document.body.classList.remove("in-trials");
  document.getElementById("tools").replaceChildren();
  document.getElementById("progress").hidden = true;
  showPage(frame.main, messagePage({ title, text, action: labelled }));
}

/**
 * Show why the study cannot be used: the text of `refusal` with this name, else the message.
 * @param {Basis} basis
 * @param {string} name
 * @param {{message?: string, completion?: import("./messages.js").Completion|null,
 *   another?: (() => void)|null}} [given] `completion`: how the participant reports back.
 */
function refuse(basis, name, { message = "", completion = null, another = null } = {}) {
  const { texts, frame, study, address } = basis;
  const known = texts.has(`refusal.${name}`);
  const values = { width: study.min_width, height: study.min_height, minutes: study.hold_minutes };
  const reason = known ? texts.t(`refusal.${name}`, values) : texts.t("refusal.other", { message });
  const text = `${reason}\n\n${texts.t("refusal.contact", study)}`;
  const reload = { label: texts.t("refusal.again"), run: () => window.location.reload() };
  // The URL by which the participant came identifies the person again.
  const restart = { label: texts.t("refusal.again"), run: () => window.location.replace(address) };
  const action = name === "unknown_token" ? restart : known ? null : reload;
  const title = texts.t(name === "already_took_part" ? "result.title" : "refusal.title");
  document.body.classList.remove("in-trials");
  document.getElementById("tools").replaceChildren();
  document.getElementById("progress").hidden = true;
  const quiet = another && { label: texts.t("common.another_person"), run: another };
  const reports = completion?.code || completion?.url;
  const parts = reports ? completionParts(completion, bound(texts).t, "ended.go_hint") : [];
  const page = { title, text, parts, action, quiet: known ? quiet : null };
  showPage(frame.main, messagePage(page));
}

begin().catch((error) => {
  console.error(error);
  showPage(document.getElementById("main"), messagePage({ title: "Error", text: String(error) }));
});
