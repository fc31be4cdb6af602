// Writes files of the phone's own storage (OPFS), byte by byte as they come: what is written stays when the page ends.

/** @type {Map<string, any>} */
const files = new Map();

/** @param {string} name */
async function opened(name) {
  const folder = await navigator.storage.getDirectory();
  const file = await folder.getFileHandle(name, { create: true });
  return /** @type {any} */ (file).createSyncAccessHandle();
}

onmessage = async ({ data: { id, what, name, at, bytes } }) => {
  try {
    if (what === "open") {
      files.set(name, await opened(name));
      files.get(name).truncate(0);
    } else if (what === "write") {
      if (files.get(name).write(bytes, { at }) !== bytes.byteLength) throw new DOMException("", "QuotaExceededError");
    } else if (what === "close") {
      files.get(name).flush();
      files.get(name).close();
      files.delete(name);
    } else {  // put: a small file at once
      const file = await opened(name);
      file.truncate(0);
      file.write(bytes, { at: 0 });
      file.flush();
      file.close();
    }
    postMessage({ id });
  } catch (error) {
    postMessage({ id, error: /** @type {Error} */ (error).name });
  }
};
