#!/bin/sh
# Start of every container: copy the models from the image into the cache (a new volume is empty), then run pbl.
set -eu
umask 077
refused() { # what: end with a coded error, which `docker compose logs` shows
    printf '%s\n' "ASSET_MISSING: $1" "  expected: readable models in $seed, and a folder PBL_CACHE that user $(id -u) may write" \
        "  next: give $PBL_CACHE to that user (or empty the volume: docker compose down; docker volume rm NAME_cache), then start again" >&2
    exit 1
}
seed="${PBL_SEED:-/opt/pbl-cache}"
if [ -d "$seed" ]; then
    mkdir -p "$PBL_CACHE" || refused "$PBL_CACHE cannot be made"
    # Hidden files are locks and remains of the build.
    (cd "$seed" && find . -type f ! -name '.*') | while IFS= read -r file; do
        [ -e "$PBL_CACHE/$file" ] && continue
        # Copied and then renamed: another container that starts at the same time never reads half a file.
        aside="$(mktemp "$PBL_CACHE/.seed.XXXXXX")" || refused "$PBL_CACHE cannot be written"
        if ! cp "$seed/$file" "$aside" || ! mkdir -p "$(dirname "$PBL_CACHE/$file")" || ! mv "$aside" "$PBL_CACHE/$file"; then
            rm -f "$aside"
            refused "$seed/$file cannot be copied to $PBL_CACHE"
        fi
    done
fi
exec pbl "$@"
