// Recordings on the phone, until the server says by their sum that it has them.

/** @typedef {{name: string, visit: number, made: number, about: Record<string, any>, log: any, complete: boolean}} Facts */

const worker = new Worker("/phone/store.js");
/** @type {Map<number, {done: () => void, failed: (error: any) => void}>} */
const asked = new Map();
let count = 0;
worker.onmessage = ({ data: { id, error } }) => {
  const { done, failed } = /** @type {any} */ (asked.get(id));
  asked.delete(id);
  if (error) failed(new DOMException("", error)); else done();
};

/** @param {string} what @param {string} name @param {{at?: number, bytes?: Uint8Array}} more @returns {Promise<void>} */
function ask(what, name, more = {}) {
  return new Promise((done, failed) => {
    asked.set(++count, { done, failed });
    worker.postMessage({ id: count, what, name, ...more });
  });
}

/** A file that grows. @param {string} name */
export async function newFile(name) {
  await ask("open", `${name}.mp4`);
  return {
    write: (/** @type {number} */ at, /** @type {Uint8Array} */ bytes) => ask("write", `${name}.mp4`, { at, bytes }),
    close: () => ask("close", `${name}.mp4`),
  };
}

let last = Promise.resolve();
/** One after the other: a file that is written while it is read cannot be read.
 * @template T @param {() => Promise<T>} act @returns {Promise<T>} */
function alone(act) {
  const done = last.then(act);
  last = done.then(() => {}, () => {});
  return done;
}

/** One line; where the page was killed while the file was written again, the end of an older, longer one follows it.
 * @param {Facts} facts */
export function keep(facts) {
  const bytes = new TextEncoder().encode(`${JSON.stringify(facts)}\n`);
  return alone(() => ask("put", `${facts.name}.json`, { bytes }));
}

/** @param {string} name */
export async function remove(name) {
  const folder = await navigator.storage.getDirectory();
  for (const end of [".mp4", ".json"]) await folder.removeEntry(name + end).catch(() => {});
}

/** What lies on the phone, the oldest first. Removes what holds no picture, and nothing that cannot be read now.
 * @returns {Promise<Facts[]>} */
export function all() {
  return alone(async () => {
    const folder = /** @type {any} */ (await navigator.storage.getDirectory()), found = [];
    for await (const [name, file] of folder.entries()) {
      if (!name.endsWith(".json")) continue;
      try {
        const film = name.replace(".json", ".mp4");
        if ((await (await folder.getFileHandle(film, { create: true })).getFile()).size)
          found.push(JSON.parse((await (await file.getFile()).text()).split("\n", 1)[0]));
        else for (const empty of [film, name]) await folder.removeEntry(empty);  // not of a take that begins: it is open
      } catch {}  // it is read again in a few seconds
    }
    return found.sort((a, b) => a.made - b.made);
  });
}

/** An answer of the server that says why it does not take a recording. */
export class Refusal extends Error {
  /** @param {number} status @param {any} error */
  constructor(status, error) {
    super(error?.found ?? String(status));
    this.status = status, this.code = error?.code ?? "", this.expected = error?.expected ?? "";
  }
}

/** The last answers that have a tag: the server does not repeat what has not changed. @type {Map<string, {tag: string, told: any}>} */
const answers = new Map();

/** @param {string} path @param {RequestInit} more */
export async function request(path, more = {}) {
  const kept = answers.get(path);
  const answer = await fetch(path, { cache: "no-store", ...(kept ? { headers: { "if-none-match": kept.tag } } : {}), ...more });
  if (answer.status === 304) return kept?.told;
  const told = answer.status === 204 ? null : await answer.json().catch(() => null);
  if (!answer.ok) throw new Refusal(answer.status, told?.error);
  const tag = answer.headers.get("etag");
  if (tag) answers.set(path, { tag, told });
  return told;
}

/** @param {BufferSource} bytes */
const sum = (bytes) => crypto.subtle.digest("SHA-256", bytes);
/** @param {ArrayBuffer} bytes */
export const hex = (bytes) => [...new Uint8Array(bytes)].map((b) => b.toString(16).padStart(2, "0")).join("");

/** Send a recording, or what of it is not there yet; returns what the server says of it.
 * @param {Facts} facts @param {number} size of a part @param {(share: number) => void} progress */
export async function send(facts, size, progress) {
  const folder = await navigator.storage.getDirectory();
  const film = await (await folder.getFileHandle(`${facts.name}.mp4`)).getFile();
  const log = new Blob(facts.log ? [JSON.stringify(facts.log)] : []);
  const whole = new Blob([film, log]), sums = [];
  const part = (/** @type {number} */ n) => whole.slice(n * size, (n + 1) * size).arrayBuffer();
  for (let n = 0; n * size < whole.size; n += 1) sums.push(await sum(await part(n)));
  const sha256 = hex(await sum(await new Blob(sums).arrayBuffer()));
  const json = { "content-type": "application/json" };
  const stated = { ...facts.about, sha256, video_bytes: film.size, log_bytes: log.size };
  let told = await request("/phone/recordings.json", { method: "POST", headers: json, body: JSON.stringify(stated) });
  for (const n of told.missing) {
    progress((sums.length - told.missing.length + told.missing.indexOf(n)) / sums.length);
    const body = await part(n);
    const headers = { "content-type": "application/octet-stream", "x-sha256": hex(sums[n]),
      "content-range": `bytes ${n * size}-${n * size + body.byteLength - 1}/${whole.size}` };
    await request(`/phone/recordings/${told.number}.json`, { method: "PUT", headers, body });
  }
  progress(1);
  if (told.state === "uploading") told = await request(`/phone/finish/${told.number}.json`, { method: "POST", headers: json, body: "{}" });
  if (told.sha256 !== sha256) throw new Refusal(422, { found: "another sum" });
  return told;
}
