// While a visit is computed: shows how far it is, and loads the page again at the end unless something was changed on it.

const EVERY_MS = 1500;

/** Ask until nothing is computed any more. @param {HTMLElement} at */
async function follow(at) {
  const told = /** @type {HTMLElement} */ (at.querySelector(".told"));
  for (;;) {
    await new Promise((go) => setTimeout(go, EVERY_MS));
    const answer = await fetch(at.dataset.state ?? "").catch(() => null);
    if (!answer) continue;  // the server is away for a moment: what is said stays
    if (!answer.ok) break;  // signed out, or the visit is gone: the page itself says so
    const page = new DOMParser().parseFromString(await answer.text(), "text/html");
    const part = /** @type {HTMLElement|null} */ (page.querySelector(".progress"));
    if (!part) break;
    if (told.innerHTML.trim() !== part.outerHTML.trim()) told.replaceChildren(part);
    if (part.dataset.busy !== "yes") break;
  }
  // Corrections that are not saved are not lost: then the link loads the page.
  const save = /** @type {HTMLButtonElement|null} */ (document.querySelector("form.correct .save"));
  if (!save || save.disabled) location.reload();
}

const at = /** @type {HTMLElement|null} */ (document.querySelector(".computing[data-state]"));
if (at) follow(at);
