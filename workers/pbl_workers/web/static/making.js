// A page that waits for a file: shows how far it is and loads itself again when that has ended.

const EVERY_MS = 700;

/** Ask until the file is there or failed. @param {HTMLElement} at @param {() => void} ended */
async function wait(at, ended) {
  const bar = /** @type {HTMLProgressElement} */ (at.querySelector("progress"));
  for (;;) {
    const answer = await fetch(at.dataset.state ?? "").catch(() => null);
    if (answer?.ok) {
      /** @type {{ended: boolean, share: number}} */ const state = await answer.json();
      bar.value = state.share;
      if (state.ended) { ended(); return; }
    } else if (answer) { ended(); return; }  // signed out, or gone: the page itself says so
    await new Promise((go) => setTimeout(go, EVERY_MS));
  }
}

const waiting = /** @type {HTMLElement|null} */ (document.querySelector(".waiting[data-state]"));
if (waiting) wait(waiting, () => location.reload());
