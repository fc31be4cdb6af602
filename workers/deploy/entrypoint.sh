#!/bin/sh
# Start of every container: copy the models from the image into the cache (a new volume is empty), then run pbl.
set -eu
umask 077
seed="${PBL_SEED:-/opt/pbl-cache}"
if [ -d "$seed" ]; then
    mkdir -p "$PBL_CACHE"
    (cd "$seed" && find . -type f) | while IFS= read -r file; do
        [ -e "$PBL_CACHE/$file" ] && continue
        # Copied and then renamed: another container that starts at the same time never reads half a file.
        aside="$(mktemp "$PBL_CACHE/.seed.XXXXXX")"
        cp "$seed/$file" "$aside"
        mkdir -p "$(dirname "$PBL_CACHE/$file")"
        mv "$aside" "$PBL_CACHE/$file"
    done
fi
exec pbl "$@"
