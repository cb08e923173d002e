/**
 * Who takes part in this browser now: somebody new, or who took part in it before.
 * @module entering
 */

import { measureDevice } from "./gate.js";
import { showPage } from "./page_trial.js";
import { busyPage } from "./pages.js";
import {
  forgetPerson,
  forgetSession,
  isFoundAgain,
  remember,
  remembered,
  visitWord,
  whoOf,
} from "./remembered.js";

/**
 * Begin a session, or go on with the one that the address or the browser knows.
 * @param {any} basis
 * @param {ReturnType<typeof import("./arrival.js").readArrival>} arrival
 * @returns {Promise<any>} `State`
 */
export async function enter({ api, texts, study, log, frame }, arrival) {
  const device = await measureDevice();
  const who = await whoOf(arrival.enter);
  const known = remembered();
  // On a shared computer the one who was here before may be somebody else.
  const own = known && (who === null || known.who === who) ? known : null;
  if (own && who === null) {
    const state = await resume(api, own, arrival.enter.scenario);
    if (state) {
      log.add("loaded", { ...device });
      hideAddress(api.token);
      return state;
    }
  }
  try {
    const onBusy = (ms) => showPage(frame.main, busyPage({ texts }, ms));
    const message = { ...arrival.enter, language: texts.language, device };
    if (who === null) message.visit = visitWord(study);
    const entered = await api.post("/api/enter", message, { onBusy });
    api.token = entered.token;
    remember({ token: entered.token, who, link: linkOf(arrival) });
    hideAddress(api.token);
    return await api.get("/api/session?load=true");
  } catch (error) {
    if (error.code !== "already_took_part" || !own) throw error;
    // In the browser in which they took part, people still find their result.
    const state = await resume(api, own, arrival.enter.scenario);
    if (state?.stage !== "done") throw error;
    return state;
  }
}

/** The state of a remembered session; null where there is none, or it is of another scenario. */
async function resume(api, { token, who }, scenario) {
  try {
    const state = await api.get("/api/session?load=true", { token });
    if (scenario && state.scenario !== scenario) return null;
    api.token = token;
    return state;
  } catch (error) {
    // Who came by an id has to come by it again, else a second session would begin.
    if (error.code !== "unknown_token" || who !== null) throw error;
    forgetSession();
    return null;
  }
}

/**
 * How the next person at this computer begins; null where people have ids of their own.
 * @param {any} study `PublicStudy`
 * @param {ReturnType<typeof import("./arrival.js").readArrival>} arrival
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

/** Did whoever takes part here come without an id? @returns {boolean} */
export const cameWithoutId = () => remembered()?.who === null;

/** What an address names that is not about one person. */
function linkOf({ enter, language }) {
  const named = Object.entries({ scenario: enter.scenario, language });
  const query = new URLSearchParams(named.filter(([, value]) => value)).toString();
  return query && `?${query}`;
}

/** Where the browser keeps nothing, a reload needs the address to find the session again. */
function hideAddress(token) {
  if (!isFoundAgain(token)) return;
  window.history.replaceState(null, "", window.location.pathname);
}
