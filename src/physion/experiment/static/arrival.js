/**
 * Identification of the participant by the URL parameters of recruiters and of the lab's links.
 * @module arrival
 */

import { isOfStudy } from "./remembered.js";

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
