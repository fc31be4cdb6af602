// The page of a phone that films a visit: opens the camera, films, keeps, sends, and shows what the server says.

import { openCamera, Take } from "./capture_film.js";
import { lookAt } from "./capture_look.js";
import { logOf, Sensors, up } from "./capture_sensors.js";
import { all, keep, newFile, Refusal, remove, request, send } from "./capture_takes.js";

const LEAST_ROOM = 3e8, AGAIN_MS = 3000, COUNT_S = 2;
const page = /** @type {HTMLElement} */ (document.querySelector("main"));
const texts = JSON.parse(page.dataset.said ?? "{}"), language = document.documentElement.lang;
const visit = Number(page.dataset.visit), size = Number(page.dataset.part);
const $ = (/** @type {string} */ at) => /** @type {any} */ (page.querySelector(at));
const [video, record, allow, clock, level, list] = [$("video"), $(".record"), $(".allow"), $(".clock"), $(".level"), $(".takes")];
const sensors = new Sensors();

/** @param {string} name @param {Record<string, any>} values */
function t(name, values = {}) {
  return texts[name][language].replace(/\{(\w+)\}/g, (/** @type {string} */ _, /** @type {string} */ key) => values[key]);
}

/** @param {string} name @param {string} more */
function say(name, more = "") {
  $(".said").textContent = [name && t(name), more].filter(Boolean).join(" ");
}

// ---------------------------------------------------------------------------------------------------------- filming
/** @type {MediaStream|null} */
let stream = null;
/** @type {Take|null} */
let take = null;
/** @type {any} */
let taken = null;
let why = "";
/** The step of the protocol that is filmed. @type {any} */
let chosen = null;

/** @type {Promise<void>|null} */
let listening = null;
/** @type {any} */
let looking = null;

async function open() {
  if (!navigator.mediaDevices) return say("not_secure");
  listening ??= sensors.listen();  // within the tap: iOS asks for it
  try {
    stream = await openCamera();
  } catch (error) {
    const name = /** @type {Error} */ (error).name;
    return say(name === "NotFoundError" ? "no_camera" : name === "NotReadableError" ? "busy" : "denied");
  }
  await listening;
  video.srcObject = stream;
  video.onresize = () => page.style.setProperty("--shape", `${video.videoWidth} / ${video.videoHeight}`);
  await video.play();
  allow.hidden = true, record.hidden = false;
  record.focus();
  stream.getVideoTracks()[0].onended = () => stop("interrupted");
  looking ??= lookAt(video, (cut) => {
    tell(".cut", cut && t(`cut_${cut}`));
    $(".cut").dataset.cut = cut;
    if (cut && take) navigator.vibrate?.(60);
  });
  setTimeout(() => { if (!take) say("ready", sensors.source ? "" : t("no_sensors")); }, 700);
}
allow.onclick = open;

/** Say and vibrate, for who looks at the person and not at the screen. @param {string} text @param {number} ms */
function cue(text, ms) {
  navigator.vibrate?.(ms);
  if (!globalThis.SpeechSynthesisUtterance) return;
  speechSynthesis.cancel();
  speechSynthesis.speak(Object.assign(new SpeechSynthesisUtterance(text), { lang: language }));
}

let counting = 0;  // a timer: another tap, or a page that goes away, ends it

/** Seconds until filming starts. @param {number} left */
function count(left) {
  page.dataset.filming = "soon";
  record.textContent = t("cancel");
  clock.textContent = String(left);
  $(".said").textContent = t("soon", { n: left });
  cue(String(left), 60);
  counting = setTimeout(() => { if (left > 1) return count(left - 1); counting = 0; start(); }, 1000);
}

function uncount() {
  clearTimeout(counting);
  counting = 0;
  page.dataset.filming = "no";
  record.textContent = t("start");
  clock.textContent = "";
  say("ready");
}
record.onclick = () => (take ? stop("") : counting ? uncount() : count(COUNT_S));

async function start() {
  const { quota = 1e12, usage = 0 } = await navigator.storage.estimate();
  if (quota - usage < LEAST_ROOM) { uncount(); return say("full"); }
  navigator.storage.persist?.();
  /** @type {any} */ (navigator).wakeLock?.request("screen").catch(() => {});
  const name = `take-${Date.now()}-${Math.random().toString(36).slice(2, 8)}`;
  const file = await newFile(name);
  taken = { name, visit, made: Date.now(), about: stated(), log: null, complete: false, file };
  why = "";
  sensors.trim();
  take = new Take(/** @type {MediaStream} */ (stream), video, file, await phoneModel(), (name) => stop(name));
  await keepFacts();
  await take.start();
  page.dataset.filming = "yes";
  record.textContent = t("stop");
  say("filming");
  cue(t("say_start"), 200);
}

/** What is stated of the recording that is filmed now. */
function stated() {
  const form = new FormData($("form"));
  const told = Object.fromEntries([...form].filter(([, value]) => value).map(([name, value]) => [name, String(value)]));
  return { ...told, ...(chosen ? { activity: chosen.activity, pace: chosen.pace } : {}) };
}

/** Its facts on the phone, with the log so far: also of one that is never ended. */
async function keepFacts() {
  if (take?.startMs) taken.log = logOf(sensors.samples, take.startMs, take.endMs, await phoneModel());
  const { file, ...facts } = taken;
  await keep(facts);
}

async function phoneModel() {
  const about = await /** @type {any} */ (navigator).userAgentData?.getHighEntropyValues(["model", "platform"]).catch(() => null);
  const [, told = ""] = /\(([^;)]+)/.exec(navigator.userAgent) ?? [];
  return { make: about?.platform || (/^iP/.test(told) ? "Apple" : "browser"), model: (about?.model || told).slice(0, 64) };
}

/** @param {string} reason a text, where it ended by itself */
async function stop(reason) {
  if (counting) uncount();
  if (!take || why) return;
  cue(t("say_stop"), 400);
  const ending = take;
  why = reason || "stopped";
  await ending.stop();
  await taken.file.close();
  page.dataset.filming = "no";
  record.textContent = t("start");
  if (!ending.frames) {
    take = null;
    await remove(taken.name);
    return say(reason || "interrupted");
  }
  taken.about = { ...taken.about, frames: ending.frames, dropped: ending.dropped, sensor: sensors.source, camera: ending.how };
  await keepFacts().catch(() => { reason = "full"; });  // those of two seconds ago stay
  take = null;
  page.dataset.times = JSON.stringify(ending.times), page.dataset.start = String(ending.startMs);
  const lost = ending.dropped ? t("dropped", { n: ending.dropped, all: ending.frames + ending.dropped }) : "";
  say(reason, [lost, ending.how.includes("/") ? t("fallback") : ""].filter(Boolean).join(" "));
  $(".film").hidden = true, $(".after").hidden = false;
  $(".keep").focus();
}

/** @param {boolean} kept */
async function decided(kept) {
  $(".film").hidden = false, $(".after").hidden = true;
  let said = "ready";
  if (kept) {
    const { file, ...facts } = { ...taken, complete: true };
    await keep({ ...facts, about: { ...facts.about, ...stated() } }).then(() => { $("[name=note]").value = ""; }, () => { said = "full"; });
  } else await remove(taken.name);
  say(said);
  await show();
  sendAll();
}
$(".keep").onclick = () => decided(true);
$(".again").onclick = () => decided(false);

document.addEventListener("visibilitychange", () => { if (document.hidden) stop("interrupted"); });
addEventListener("pagehide", () => stop("interrupted"));

setInterval(() => {
  if (take) {
    const s = Math.max(0, take.endMs - take.startMs) / 1000;
    clock.textContent = `${Math.floor(s / 60)}:${String(Math.floor(s % 60)).padStart(2, "0")}`;
    if (s > Number(page.dataset.most)) stop("too_long");
  } else sensors.trim();
  if (!sensors.last) return;
  const [x, y] = up(sensors.last), held = Math.round(Math.atan2(x, y) / (Math.PI / 2)) * 90;
  const tilt = (Math.atan2(x, y) * 180) / Math.PI - held;
  level.firstElementChild.style.transform = `rotate(${tilt}deg)`;
  level.dataset.level = Math.abs(tilt) < 2 ? "yes" : "no";
  level.ariaLabel = `${t("level")}: ${tilt.toFixed(0)}°`;
}, 200);
setInterval(() => { if (take && !why) keepFacts().catch(() => stop("full")); }, 2000);

// ---------------------------------------------------------------------------------------------------------- sending
/** @type {Map<string, string>} */
const states = new Map();
let sending = false;

async function sendAll() {
  if (sending) return;
  sending = true;
  try {
    for (const facts of (await all()).filter((one) => one.complete && one.visit === visit)) {
      const told = await send(facts, size, (share) => {
        states.set(facts.name, t("sending", { n: Math.floor(100 * share) }));
        show();
      });
      states.set(facts.name, told.verdict);
      if (told.state === "received") await remove(facts.name);
      else await keep({ ...facts, complete: false, about: { ...facts.about, why: told.verdict } });
    }
    if (!take && navigator.onLine && ["no_network", "ended"].some((name) => $(".said").textContent === t(name))) say("");
  } catch (error) {
    if (error instanceof Refusal && (error.code === "PHONE_LINK" || error.status === 401)) say("ended");
    else if (!(error instanceof Refusal)) say("no_network");
    else say("", error.message);
  }
  sending = false;
  await show();
}

// Logs of wearable sensors, which an app or a computer wrote while it was filmed.
$("[name=worn]").onchange = () => { $(".worn").hidden = !$("[name=worn]").checked; };
$(".worn input").onchange = async () => {
  const lines = $(".worn ul"), { failed, gone } = $(".worn").dataset, body = new FormData(), names = [];
  body.append("segment", $(".worn select").value);
  for (const file of $(".worn input").files)
    if (await file.slice(0, 1).arrayBuffer().catch(() => null)) body.append("worn", file), names.push(file.name);
    else lines.prepend(item(file.name, gone));
  $(".worn input").value = "";
  if (!names.length) return;
  const line = item(names.join(", "), t("sending", { n: 0 }));
  lines.prepend(line);
  const { outcomes } = await request("/phone/sensors.json", { method: "POST", body }).catch((error) => ({ outcomes: [
    { name: names.join(", "), said: error instanceof Refusal ? `${error.message}; ${error.expected}` : failed }] }));
  line.replaceWith(...outcomes.map((/** @type {any} */ one) => item(one.name, `${one.taken ? "\u2713 " : ""}${one.said}`)));
};
$("[name=worn]").onchange();

/** The steps of the protocol: what came is ticked off, a tap chooses what is filmed now. @param {any[]} steps */
function lead(steps) {
  const open = steps.find((step) => step.done < step.passes), now = steps.find((step) => step.number === chosen?.number);
  const lacks = (/** @type {any} */ step) => step.done + step.waiting < step.passes;  // those that are being checked may do
  if (!chosen || (now && lacks(chosen) && !lacks(now))) choose(steps.find(lacks) ?? open ?? now ?? steps[0]);
  else chosen = now ?? chosen;
  $(".protocol").hidden = !steps.length;
  $(".complete").textContent = steps.length && !open ? t("complete") : "";
  fill($(".steps"), steps.map((step) => {
    const line = document.createElement("li"), button = document.createElement("button");
    const of = (/** @type {string} */ name) => (texts[`is_${step[name]}`] ? t(`is_${step[name]}`) : step[name]);
    button.type = "button";
    button.textContent = `${step.done >= step.passes ? "\u2713 " : ""}${[of("activity"), of("pace"), t(`view_${step.view}`)].filter(Boolean).join(", ")}: ${t("done", { n: step.done, all: step.passes })}${step.waiting ? `; ${t("arrived", { n: step.waiting })}` : ""}`;
    button.ariaPressed = String(step.number === chosen?.number);
    button.onclick = () => { choose(step); lead(steps); };
    line.append(button);
    return line;
  }));
}

/** @param {any} step */
function choose(step) {
  chosen = step ?? null;
  $("form").elements.step.value = step?.number ?? "";
}

/** The recordings of this phone and of the visit. */
async function show() {
  const found = await all(), told = await request("/phone/state.json").catch(() => null);
  const lines = found.filter((one) => one.name !== taken?.name || !take).map((one) => {
    const own = one.visit !== visit ? t("other_visit") : one.about.why ?? states.get(one.name) ?? t("on_phone");
    const line = item(new Date(one.made).toLocaleTimeString(language), own);
    line.dataset.name = one.name;
    if (one.complete && !one.about.why) return line;
    const buttons = [[t("remove"), () => remove(one.name)]];
    if (!one.about.why && one.visit === visit) buttons.unshift([t("keep"), () => complete(one.name).then(sendAll, () => say("full"))]);
    for (const [label, act] of buttons) {
      const button = document.createElement("button");
      button.textContent = label;
      button.onclick = () => act().then(show);
      line.append(" ", button);
    }
    return line;
  });
  for (const one of told?.recordings ?? [])
    if (one.state !== "uploading") lines.push(item(`${one.number}`, one.verdict));
  // What became of the last one: not of the one before, while it is on its way.
  const waits = found.filter((one) => one.complete && one.visit === visit).pop();
  if (waits) tell(".latest", states.get(waits.name) ?? t("on_phone"));
  else if (told) tell(".latest", told.recordings[0]?.verdict ?? "");
  if (told) tell(".next", told.next), $(".usual").hidden = !told.checked || !$(".usual").textContent;
  if (told && !take) lead(told.protocol);
  fill(list, lines.length ? lines : [item("", t("none_yet"))]);
  const { quota = 0, usage = 0 } = await navigator.storage.estimate();
  const battery = await /** @type {any} */ (navigator).getBattery?.().catch(() => null);
  $(".room").textContent = t("room", { gb: ((quota - usage) / 1e9).toLocaleString(language, { maximumFractionDigits: 1 }) }) + (battery ? ` · ${t("battery", { n: Math.round(100 * battery.level) })}` : "");
}

/** Its facts as they are now, not as they were when its line was made: another page may have ended it since.
 * @param {string} name */
async function complete(name) {
  const facts = (await all()).find((one) => one.name === name);
  if (facts) await keep({ ...facts, complete: true });
}

/** A screen reader reads it again only where it is another. @param {string} at @param {string} text */
function tell(at, text) {
  if ($(at).textContent !== text) $(at).textContent = text;
}

/** A list is made again only where it is another: a button that is replaced under a finger loses the tap.
 * @param {Element} at @param {Element[]} lines */
function fill(at, lines) {
  const html = (/** @type {Element[]} */ all) => all.map((one) => one.outerHTML).join();
  if (html([...at.children]) !== html(lines)) at.replaceChildren(...lines);
}

/** @param {string} head @param {string} text */
function item(head, text) {
  const line = document.createElement("li"), strong = document.createElement("b");
  strong.textContent = head;
  line.append(strong, ` ${text}`);
  return line;
}

setInterval(sendAll, AGAIN_MS);
addEventListener("online", sendAll);
navigator.serviceWorker?.register("/phone/offline.js", { scope: "/phone" }).catch(() => {});
show().then(sendAll);
// Where the sensors are asked for within a tap alone (iOS), the camera waits for that tap.
const kinds = /** @type {any} */ (globalThis);
if (kinds.RelativeOrientationSensor || !kinds.DeviceOrientationEvent?.requestPermission) open();
page.dataset.ready = "yes";
