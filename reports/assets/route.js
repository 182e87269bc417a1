// Every view is a link: the part after # says which, as field=value pairs.

/** @returns {Record<string, string>} */
export function read() {
  return Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
}

/**
 * The link to the view with these fields; empty ones are left out.
 * @param {Record<string, any>} fields
 */
export function href(fields) {
  const kept = Object.entries(fields).filter(([, value]) => value !== "" && value !== null && value !== undefined && value !== false);
  return "#" + new URLSearchParams(kept.map(([key, value]) => [key, String(value)]));
}

/**
 * Change fields of the present view in the address without a new entry in the history.
 * @param {Record<string, any>} changes
 */
export function amend(changes) {
  history.replaceState(null, "", href({ ...read(), ...changes }));
}

/** @param {Record<string, string>} fields */
export function viewOf(fields) {
  if (fields.scenario !== undefined && fields.engine !== undefined && !fields.view) return "cell";
  return ["cost", "trend", "gaps"].includes(fields.view) ? fields.view : "matrix";
}
