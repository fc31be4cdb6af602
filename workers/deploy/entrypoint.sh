#!/bin/sh
# Start of every container: bring the models that came with the image into the cache (a volume may be empty), run pbl.
set -eu
umask 077
seed="${PBL_SEED:-/opt/pbl-cache}"
if [ -d "$seed" ]; then
    mkdir -p "$PBL_CACHE"
    (cd "$seed" && find . -type f) | while IFS= read -r file; do
        [ -e "$PBL_CACHE/$file" ] && continue
        # Copied aside and renamed: another container that starts at the same time never meets half a file.
        aside="$(mktemp "$PBL_CACHE/.seed.XXXXXX")"
        cp "$seed/$file" "$aside"
        mkdir -p "$(dirname "$PBL_CACHE/$file")"
        mv "$aside" "$PBL_CACHE/$file"
    done
fi
exec pbl "$@"
