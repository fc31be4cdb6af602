// The page behind a link for filming goes on by itself; without scripts a tap does.

/** @type {HTMLFormElement} */ (document.querySelector("form.open")).requestSubmit();
