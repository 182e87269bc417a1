// Packed data in the page: gzip(header length, header JSON, arrays) in printable characters, inflated when first looked at.

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
  const bytes = bytesOf(element.textContent ?? "");
  const texts = name === "texts" ? [] : (await chunk("texts")) ?? [];
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const body = await new Response(stream).arrayBuffer();
  const length = new DataView(body).getUint32(0, true);
  const { kinds, sizes, header } = JSON.parse(new TextDecoder().decode(new Uint8Array(body, 4, length)));
  let offset = 4 + length;
  const arrays = sizes.map((/** @type {number} */ size, /** @type {number} */ k) => {
    const kind = kinds.slice(3 * k, 3 * k + 2);
    const planes = new Uint8Array(body, offset, Number(kind[1]) * size);
    offset += planes.length;
    return arrayOf(planes, kind);
  });
  const filled = fill(header, arrays, texts);
  return name === "texts" ? textsOf(filled) : filled;
}

/**
 * The array whose lowest bytes come first, then the higher ones.
 * @param {Uint8Array} planes @param {string} kind
 */
function arrayOf(planes, kind) {
  const width = Number(kind[1]);
  const size = planes.length / width;
  const bytes = new Uint8Array(planes.length);
  for (let i = 0; i < size; i++) for (let k = 0; k < width; k++) bytes[width * i + k] = planes[size * k + i];
  const Type = { f4: Float32Array, u4: Uint32Array, u2: Uint16Array, i2: Int16Array, u1: Uint8Array, i1: Int8Array }[/** @type {"f4"} */ (kind)];
  return new Type(bytes.buffer);
}

/**
 * The bytes of a chunk: of two characters 13 bits, in base 91 of the printable ones without ", & and <.
 * @param {string} text its length, a colon and its characters
 */
function bytesOf(text) {
  const start = text.indexOf(":") + 1;
  const bytes = new Uint8Array(parseInt(text));
  /** @param {number} i */
  const digit = (i) => {
    const c = text.charCodeAt(i);
    return c - 33 - Number(c > 34) - Number(c > 38) - Number(c > 60);
  };
  let [buffer, count, at] = [0, 0, 0];
  for (let i = start; i < text.length; i += 2) {
    buffer = (buffer << 13) | (91 * digit(i) + digit(i + 1));
    for (count += 13; count >= 8 && at < bytes.length; at++) bytes[at] = (buffer >> (count -= 8)) & 255;
    buffer &= (1 << count) - 1;
  }
  return bytes;
}

/**
 * Put the numbers of each text into its template.
 * @param {{ templates: string[], codes: Uint16Array, numbers: string[][] }} packed
 */
function textsOf({ templates, codes, numbers }) {
  const parts = templates.map((template) => template.split("\0"));
  const slots = numbers.map((some) => some.map((slot) => slot.split(" ")));
  const used = templates.map(() => 0);
  return Array.from(codes, (code) => {
    const k = used[code]++;
    return parts[code].map((part, j) => (j ? slots[code][j - 1][k] : "") + part).join("");
  });
}

/**
 * Put arrays and tables where the header refers to them.
 * @param {any} value @param {ArrayLike<number>[]} arrays @param {string[]} texts
 * @returns {any}
 */
function fill(value, arrays, texts) {
  /** @param {any} item */
  const filled = (item) => fill(item, arrays, texts);
  if (Array.isArray(value)) return value.map(filled);
  if (value === null || typeof value !== "object") return value;
  if ("$" in value) return arrays[value.$];
  if ("$texts" in value) return Array.from(filled(value.$texts), (code) => texts[code - 1]);
  if ("$numbers" in value) {
    const [digits, exponents] = value.$numbers.map(filled);
    return Array.from(digits, (d, i) => (d === -32768 ? undefined : Number(`${d}e${exponents[i]}`)));
  }
  if ("$lists" in value) {
    const [counts, values] = value.$lists.map(filled);
    let end = 0;
    return Array.from(counts, (count) => Array.from(values.slice(end, (end += count)), (x) => x ?? null));
  }
  if ("$rows" in value) return records(value.$rows, value.columns, filled);
  return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, filled(item)]));
}

/**
 * The records of a table; fields without a value are absent.
 * @param {number} count @param {Record<string, any>} columns @param {(item: any) => any[]} filled
 */
function records(count, columns, filled) {
  const found = Array.from({ length: count }, () => /** @type {Record<string, any>} */ ({}));
  for (const [name, column] of Object.entries(columns)) {
    filled(column).forEach((value, i) => {
      if (value !== undefined && value !== null) found[i][name] = value;
    });
  }
  return found;
}

/**
 * The number that a log code stands for: NaN, 0 or a power of ten.
 * @param {number} code
 */
export function fromCode(code) {
  return code === 0 ? NaN : code === 1 ? 0 : 10 ** ((code - 2) / 500 - 40);
}
