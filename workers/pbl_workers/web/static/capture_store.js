// Writes files of the phone's own storage (OPFS), byte by byte as they come: what is written stays when the page ends.

/** @type {Map<string, any>} */
const files = new Map();

/** @param {string} name */
async function opened(name) {
  const folder = await navigator.storage.getDirectory();
  const file = await folder.getFileHandle(name, { create: true });
  return /** @type {any} */ (file).createSyncAccessHandle();
}

/** @param {any} file @param {Uint8Array} bytes @param {number} at */
function write(file, bytes, at) {
  if (file.write(bytes, { at }) !== bytes.byteLength) throw new DOMException("", "QuotaExceededError");
}

onmessage = async ({ data: { id, what, name, at, bytes } }) => {
  try {
    if (what === "open") {
      files.set(name, await opened(name));
      files.get(name).truncate(0);
    } else if (what === "write") {
      write(files.get(name), bytes, at);
    } else if (what === "close") {
      files.get(name).flush();
      files.get(name).close();
      files.delete(name);
    } else {  // put: a small file at once
      const file = await opened(name), before = new Uint8Array(file.getSize());
      try {
        file.read(before, { at: 0 });
        write(file, bytes, 0);
        file.truncate(bytes.byteLength);
      } catch (error) {  // a full phone: what it held stays
        file.write(before, { at: 0 });
        file.truncate(before.byteLength);
        throw error;
      } finally {
        file.flush();
        file.close();
      }
    }
    postMessage({ id });
  } catch (error) {
    postMessage({ id, error: /** @type {Error} */ (error).name });
  }
};
