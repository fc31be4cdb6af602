// Keeps the phone's page usable without network: what it consists of, as it was loaded last.

const CACHE = "phone-1";
const PARTS = ["/phone", "/static/page.css", "/static/capture.css", "/static/icon.svg", "/static/capture.js", "/static/capture_film.js", "/static/capture_look.js",
  "/static/capture_sensors.js", "/static/capture_takes.js", "/phone/store.js", "/vendor/mediabunny-1.61.0.min.js"];
const worker = /** @type {any} */ (self);

worker.addEventListener("install", (/** @type {any} */ event) => {
  worker.skipWaiting();
  event.waitUntil(caches.open(CACHE).then((cache) => cache.addAll(PARTS)));
});
worker.addEventListener("activate", (/** @type {any} */ event) => event.waitUntil(worker.clients.claim()));
worker.addEventListener("fetch", (/** @type {any} */ event) => {
  const path = new URL(event.request.url).pathname;
  if (event.request.method === "GET" && PARTS.includes(path)) event.respondWith(part(event.request, path));
});

/** From the server where it answers, else as it was. @param {Request} request @param {string} path */
async function part(request, path) {
  const cache = await caches.open(CACHE);
  try {
    const answer = await fetch(request);
    if (answer.ok) await cache.put(path, answer.clone());
    else if (path === "/phone") await cache.delete(path);  // the link has ended: the code of the person goes with it
    return answer;
  } catch (error) {
    const kept = await cache.match(path);
    if (kept) return kept;
    throw error;
  }
}
