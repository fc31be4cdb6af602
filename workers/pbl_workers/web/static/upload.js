// How much of an upload has arrived; without this script the form is sent as it is.
function follow() {
  const form = document.querySelector("#upload"), sent = form.querySelector(".sent"), failed = form.querySelector(".failed");
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const request = new XMLHttpRequest(), bar = form.querySelector("progress"), button = form.querySelector("button");
    request.open("POST", form.action);
    request.upload.addEventListener("progress", (now) => { if (now.lengthComputable) bar.value = now.loaded / now.total; });
    request.upload.addEventListener("load", () => { sent.querySelector("span").textContent = form.dataset.checked; bar.removeAttribute("value"); });
    request.addEventListener("error", () => { sent.hidden = true; button.disabled = false; failed.textContent = form.dataset.failed; failed.hidden = false; });
    request.addEventListener("load", () => {
      if (request.responseURL !== form.action) { location.href = request.responseURL; return; }  // where the form led
      const page = new DOMParser().parseFromString(request.responseText, "text/html");
      document.querySelector("main").replaceWith(page.querySelector("main"));
      if (document.querySelector("#upload")) follow();
      scrollTo(0, 0);
    });
    failed.hidden = true; sent.hidden = false; button.disabled = true;
    request.send(new FormData(form));
  });
}
follow();
