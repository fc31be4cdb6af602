#!/bin/sh
# The cron jobs of the container `cron`, where no cron daemon runs (it would have to be root): every minute look what is
# due. One job after the other, so that none overtakes itself. On a machine of your own use crontab or the systemd timers.
set -u
tick="${PBL_CRON_TICK_S:-60}"
trap 'exit 0' TERM INT

run() { # name...: a job that fails is said by pbl itself, and comes again
    pbl --quiet cron "$@" || echo "pbl cron $1 failed with code $?" >&2
}

minute=0
while :; do
    run import
    [ $((minute % 5)) -eq 0 ] && run refresh
    [ $((minute % 10)) -eq 0 ] && run release
    [ $((minute % 60)) -eq 30 ] && run disk
    [ $((minute % 1440)) -eq 120 ] && run reprocess
    [ $((minute % 1440)) -eq 240 ] && run summary
    minute=$((minute + 1))
    sleep "$tick" &
    wait $!
done
