// Packed data in the page: base64(gzip(header length, header JSON, arrays)), inflated when first looked at.

/** @type {Map<string, Promise<any>>} */
const opened = new Map();

/**
 * The named chunk, or null where the page has none.
 * @param {string} name
 * @returns {Promise<any>}
 */
export function chunk(name) {
  const found = opened.get(name) ?? inflate(name);
  opened.set(name, found);
  return found;
}

/** @param {string} name */
async function inflate(name) {
  const element = document.getElementById("chunk-" + name);
  if (!element) return null;
  const bytes = Uint8Array.from(atob(element.textContent ?? ""), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const body = await new Response(stream).arrayBuffer();
  const length = new DataView(body).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(body, 4, length)));
  return fill(header, body, 4 + length);
}

/**
 * Put arrays where the header refers to them.
 * @param {any} value @param {ArrayBuffer} body @param {number} start
 * @returns {any}
 */
function fill(value, body, start) {
  if (Array.isArray(value)) return value.map((item) => fill(item, body, start));
  if (value === null || typeof value !== "object") return value;
  if (!("$" in value)) {
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, fill(item, body, start)]));
  }
  const [offset, size, kind] = value.$;
  if (kind === "f4") return new Float32Array(body, start + offset, size);
  if (kind === "u1") return new Uint8Array(body, start + offset, size);
  if (kind === "i1") return new Int8Array(body, start + offset, size);
  const planes = new Uint8Array(body, start + offset, 2 * size);
  const joined = kind === "u2" ? new Uint16Array(size) : new Int16Array(size);
  for (let i = 0; i < size; i++) joined[i] = planes[i] | (planes[size + i] << 8);
  return joined;
}

/**
 * The number that a log code stands for: NaN, 0 or a power of ten.
 * @param {number} code
 */
export function fromCode(code) {
  return code === 0 ? NaN : code === 1 ? 0 : 10 ** ((code - 2) / 500 - 40);
}
