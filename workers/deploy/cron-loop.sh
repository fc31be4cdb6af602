#!/bin/sh
# Runs the cron jobs in the container `cron`, which has no cron daemon (that would have to be root): checks every minute
# which jobs are due and runs them one after the other. On a machine of your own use crontab or the systemd timers.
set -u
umask 077
tick="${PBL_CRON_TICK_S:-60}"
trap 'exit 0' TERM INT

run() { # name...: pbl itself reports why a job failed; the job runs again at its next time
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
