/**
 * Who comes, by the parameters of the address that recruiters and the lab give out.
 * @module arrival
 */

const LONGEST_ID = 200;
const LONGEST_OTHER = 500;

/**
 * @param {string} search The query of the address.
 * @param {Array<{source: string, id: string, others: string[], preview: Object<string, string>}>}
 *   recruiters As the server names them, in the order in which they are tried.
 * @returns {{enter: Object, preview: boolean, named: boolean, language: string|null}} `enter`: the
 *   beginning of an `Enter`; `preview`: only information may be shown; `named`: the address says
 *   who comes, or in what way, so that it goes before what the browser remembers.
 */
export function readArrival(search, recruiters) {
  const given = new URLSearchParams(search);
  const language = given.get("language") ?? given.get("lang");
  const recruiter = recruiters.find(
    (one) => given.has(one.id) || Object.keys(one.preview ?? {}).some((name) => given.has(name)),
  );
  const enter = { source: recruiter?.source ?? "link" };
  const id = recruiter ? given.get(recruiter.id)?.trim().slice(0, LONGEST_ID) : "";
  if (id) enter.id = id;
  const others = (recruiter?.others ?? []).filter((name) => given.get(name));
  enter.recruiter = Object.fromEntries(
    others.map((name) => [name, given.get(name).slice(0, LONGEST_OTHER)]),
  );
  for (const name of ["scenario", "pass"]) {
    const value = given.get(name);
    if (value) enter[name] = value.slice(0, LONGEST_ID);
  }
  const preview = Object.entries(recruiter?.preview ?? {}).some(
    ([name, value]) => given.get(name) === value,
  );
  return { enter, preview, named: Boolean(enter.id || enter.pass), language };
}
