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

minutes() { # since 1970: by the clock, so that a container that is started again does not begin its day anew
    echo $(($(date +%s) / 60))
}

due() { # period offset: whether such a minute has passed since the last round, which may have taken long
    [ $(((now - $2) / $1)) -gt $(((last - $2) / $1)) ]
}

last=$(($(minutes) - 1))
while :; do
    now=$(minutes)
    due 1 0 && run import
    due 5 0 && run refresh
    due 10 0 && run release
    due 60 30 && run disk
    due 1440 120 && run reprocess
    due 1440 180 && run backup
    due 1440 240 && run summary
    last=$now
    sleep "$tick" &
    wait $!
done
