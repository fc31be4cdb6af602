#!/bin/sh
# Bucket, accounts and rights in MinIO, run once after its start and safe to repeat. Passwords come from files.
set -eu
secrets="${SECRETS:-/run/secrets}"
bucket="${PBL_S3_BUCKET:-pbl}"
address="${STORE_ADDRESS:-store:9000}"

# In the environment and not on a command line, where every process could read it.
MC_HOST_store="${STORE_SCHEME:-http}://pbl_root:$(cat "$secrets/store_root")@$address"
export MC_HOST_store

mc ready store
mc mb --ignore-existing "store/$bucket"
for role in worker owner; do
    mc admin policy create store "pbl_$role" "/policies/$role.json"
    mc admin user add store "pbl_$role" "$(cat "$secrets/store_$role")"
    mc admin policy attach store "pbl_$role" --user "pbl_$role" || true # "already attached" is an error of mc
done
