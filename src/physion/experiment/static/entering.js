/**
 * Entering the study: URL parameters of recruiters and links, and the session that they, or the
 * browser, identify.
 * @module entering
 */

import { measureDevice } from "./gate.js";
import { showPage } from "./page_trial.js";
import { busyPage } from "./pages.js";
import {
  forgetPerson,
  forgetSession,
  isFoundAgain,
  isOfStudy,
  remember,
  remembered,
  visitKey,
  whoOf,
} from "./remembered.js";

const LONGEST_ID = 200;
const LONGEST_OTHER = 500;

/**
 * The URL parameters of a visit. `enter`: the identifying fields of the message; `preview`: only
 * information may be shown; `named`: the URL identifies the participant or has a signed key of its
 * own, so it takes precedence over a session that the browser remembers.
 * @typedef {{enter: import("./messages.js").Enter, preview: boolean, named: boolean,
 *   language: string|null}} Arrival
 */

/**
 * Read the URL parameters.
 * @param {string} search The query of the URL.
 * @param {import("./messages.js").Recruiter[]} recruiters In the order in which they are matched.
 * @returns {Arrival}
 */
export function readArrival(search, recruiters) {
  const given = new URLSearchParams(search);
  const language = given.get("language") ?? given.get("lang");
  const recruiter = recruiters.find(
    (one) => given.has(one.id) || Object.keys(one.preview ?? {}).some((name) => given.has(name)),
  );
  /** @type {import("./messages.js").Enter} */
  const enter = { source: recruiter?.source ?? "link" };
  const id = recruiter ? given.get(recruiter.id)?.trim().slice(0, LONGEST_ID) : "";
  if (id) enter.id = id;
  const others = (recruiter?.others ?? []).filter((name) => given.get(name));
  enter.recruiter = Object.fromEntries(
    others.map((name) => [name, given.get(name).slice(0, LONGEST_OTHER)]),
  );
  for (const name of ["scenario", "condition", "pass"]) {
    const value = given.get(name);
    if (value) enter[name] = value.slice(0, LONGEST_ID);
  }
  const preview = Object.entries(recruiter?.preview ?? {}).some(
    ([name, value]) => given.get(name) === value,
  );
  const personal = enter.pass && !isOfStudy(enter.pass);
  return { enter, preview, named: Boolean(enter.id || personal), language };
}

/** @typedef {import("./messages.js").SessionState} SessionState */

/**
 * Begin a session, or continue the one that the URL or the browser identifies.
 * @param {import("./session.js").Basis} basis
 * @param {Arrival} arrival
 * @returns {Promise<SessionState>}
 */
export async function enter({ api, texts, study, log, frame }, arrival) {
  const device = await measureDevice();
  const who = await whoOf(arrival.enter);
  const known = remembered();
  // On a shared computer the remembered session may be another person's.
  const own = known && (who === null || known.who === who) ? known : null;
  if (own && who === null) {
    const state = await resume(api, own, arrival.enter.scenario);
    if (state) {
      log.add("loaded", { ...device });
      if (state.stage !== "consent") hideAddress(api.token);
      return state;
    }
  }
  try {
    const onBusy = (ms) => showPage(frame.main, busyPage({ texts }, ms));
    const message = { ...arrival.enter, language: texts.language, device };
    // Without an id, each opening of a preview link is a new session.
    if (who === null || message.id) message.visit = visitKey(study, who);
    const entered = await api.post("/api/enter", message, { onBusy, token: own?.token });
    api.token = entered.token;
    remember({ token: entered.token, who, link: linkOf(arrival) });
    const state = await api.get("/api/session?load=true");
    // Before consent the server stores nothing: a reload must find the person by the address.
    if (state.stage !== "consent") hideAddress(api.token);
    return state;
  } catch (error) {
    if (error.code !== "already_took_part" || !own) throw error;
    // People can see their result again in the browser in which they took part.
    const state = await resume(api, own, arrival.enter.scenario);
    if (state?.stage !== "done") throw error;
    return state;
  }
}

/**
 * Return the state of a remembered session, or null if it is unknown or of another scenario.
 * @param {import("./api.js").Api} api
 * @param {import("./remembered.js").Remembered} session
 * @param {string} [scenario]
 * @returns {Promise<SessionState|null>}
 */
async function resume(api, { token, who }, scenario) {
  try {
    const state = await api.get("/api/session?load=true", { token });
    if (scenario && state.scenario !== scenario) return null;
    api.token = token;
    return state;
  } catch (error) {
    // A person with an id must use the link with the id, else a second session would begin.
    if (error.code !== "unknown_token" || who !== null) throw error;
    forgetSession();
    return null;
  }
}

/**
 * Return the function that starts the study for another person on this computer, or null if people
 * are identified by ids.
 * @param {import("./messages.js").PublicStudy} study
 * @param {Arrival} arrival
 * @returns {(() => void)|null}
 */
export function anotherPerson(study, arrival) {
  if (study.id_needed || arrival.named) return null;
  const link = remembered()?.link ?? linkOf(arrival);
  return () => {
    forgetPerson(study);
    window.location.replace(window.location.pathname + link);
  };
}

/** Return whether the current participant came without an id. @returns {boolean} */
export const cameWithoutId = () => remembered()?.who === null;

/** Return the query with the parameters that do not identify a person. @param {Arrival} arrival */
function linkOf({ enter, language }) {
  const pass = enter.pass && isOfStudy(enter.pass) ? enter.pass : null;
  const condition = pass ? enter.condition : null; // it is signed
  const named = Object.entries({ scenario: enter.scenario, condition, language, pass });
  const query = new URLSearchParams(named.filter(([, value]) => value)).toString();
  return query && `?${query}`;
}

/**
 * Remove the query from the URL, unless a reload would need it to find the session again.
 * @param {string} token
 */
export function hideAddress(token) {
  if (!isFoundAgain(token)) return;
  window.history.replaceState(null, "", window.location.pathname);
}
