#!/bin/sh
# Random passwords of 192 bits, one per file, readable by you only. Existing files are kept.
#   sh workers/deploy/make-secrets.sh [DIR]     (default: secrets/, which git ignores)
set -eu
folder="${1:-secrets}"
umask 077
mkdir -p "$folder"
for name in mysql_root pbl_owner pbl_worker pbl_analyst store_root store_owner store_worker; do
    [ -s "$folder/$name" ] || od -An -N24 -tx1 /dev/urandom | tr -d ' \n' >"$folder/$name"
done
