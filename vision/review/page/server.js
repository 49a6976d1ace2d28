/* Every request to the program that serves this page. Nothing else is ever asked. */

/** The program is not there. */
export class Gone extends Error {}

const WINDOW = crypto.randomUUID(); // by which the program tells windows apart

async function request(path, { headers = {}, ...options } = {}) {
  const answer = await fetch(path, { headers: { "X-Window": WINDOW, ...headers }, ...options })
    .catch(() => { throw new Gone("the program does not answer"); });
  if (!answer.ok) {
    const text = await answer.text();
    let message = text;
    try { message = JSON.parse(text).error ?? text; } catch { /* plain text it is */ }
    throw new Error(message || `the program answered ${answer.status}`);
  }
  return answer;
}

export async function getJson(path) { return (await request(path)).json(); }
export async function getBytes(path) { return (await request(path)).arrayBuffer(); }
export async function getImage(path) { return createImageBitmap(await (await request(path)).blob()); }

export async function post(path, body = {}) {
  const answer = await request(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  return answer.json();
}

/** The answer to something tried out; what does not fit is an error. */
export async function tryOut(path, body) {
  const answer = await post(path, body);
  if (answer.refused) throw new Error(answer.refused);
  return answer;
}

/** Things fetched once and kept, the least used forgotten first; `get` gives what is there, or asks for it. */
export class Store {
  constructor(load, arrived, most) {
    this.load = load; this.arrived = arrived; this.most = most;
    this.kept = new Map(); this.asked = new Map(); this.refused = new Map();
  }

  /** Why something cannot be had; "" where nothing says so. */
  why(key) { return this.refused.get(key) ?? ""; }

  get(key) {
    const found = this.kept.get(key);
    if (found !== undefined) { this.kept.delete(key); this.kept.set(key, found); return found; }
    if (!this.asked.has(key) && !this.refused.has(key)) this.asked.set(key, this.fetch(key));
    return null;
  }

  peek(key) { return this.kept.get(key) ?? null; }

  async fetch(key) {
    try {
      const found = await this.load(key);
      this.kept.set(key, found);
      while (this.kept.size > this.most) {
        const [oldest, value] = this.kept.entries().next().value;
        value?.close?.();
        this.kept.delete(oldest);
      }
      this.arrived(key);
    } catch (error) {
      if (error instanceof Gone) await new Promise((done) => { setTimeout(done, 1000); }); // asked for again then
      else { this.refused.set(key, error.message); this.arrived(key); }
    } finally { this.asked.delete(key); }
  }
}

/** Tells the program that this window is closed. */
export function leave() {
  fetch("api/leave", { method: "POST", keepalive: true, headers: { "Content-Type": "application/json", "X-Window": WINDOW }, body: "{}" }).catch(() => {});
}
