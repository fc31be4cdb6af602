#!/usr/bin/env bash
# What a write that broke off leaves of a hash-addressed object is not listed by DataJoint's garbage collector.
#
# Seen 2026-11-29: datajoint 2.3.5, a store in a folder.
# Behaviour: a file is written as NAME.saving and renamed. When the disk is full (here: a limit of the length of a file)
#   NAME.saving stays. `GarbageCollector.list_schema_paths` lists those of arrays (`<npy@>`), so they are collected as
#   orphans; `list_hash_paths`, for `<blob@>` and `<attach@>`, lists names of 26 letters alone. Only another write of the
#   same content takes the rest away.
# Matters: after full disks and killed processes such a store holds bytes that `dj.gc` neither counts nor removes. Look
#   for *.saving in the folder of hashes.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install datajoint==2.3.5 pymysql==1.2.4
observe venv <<'PY'
import resource
import signal
from pathlib import Path

import datajoint
from datajoint.gc import GarbageCollector
from datajoint.hash_registry import get_store_backend, put_hash

config, store = datajoint.config, Path("store").absolute()
store.mkdir()
config.stores.update({"default": "files", "files": {"protocol": "file", "location": str(store)}})
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
_, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
array = "_schema/lab/recording/id=1/array_0123456789.npy"


def left():
    return sorted(path.name.partition(".")[2] for path in store.rglob("*") if path.is_file())


resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
for name, write in (
    ("hash", lambda: put_hash(bytes(10_000), "lab", "files", config)),
    ("array", lambda: get_store_backend("files", config=config).put_buffer(bytes(10_000), array)),
):
    try:
        write()
    except OSError as error:
        print(f"{name}: {type(error).__name__}")
resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
print("left:", *left())
collector = GarbageCollector(datajoint.Schema(), store="files", config=config)
print("listed of hashes:", len(collector.list_hash_paths("lab")), "of arrays:", len(collector.list_schema_paths("lab")))
put_hash(bytes(10_000), "lab", "files", config)
print("after the same write again:", len([name for name in left() if name == "saving"]))
PY
expect <<'SEEN'
hash: OSError
array: OSError
left: npy.saving saving
listed of hashes: 0 of arrays: 1
after the same write again: 0
SEEN
