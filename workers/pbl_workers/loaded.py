"""The libraries of a working process, loaded: the supervisor has its processes forked from one that imported this."""

# ruff: noqa: E402, F401
import gc
import signal

from pbl_pipeline.resources import fewer_collections

fewer_collections()
# A terminal and systemd send them to all processes; the supervisor decides. Its SIGTERM to a copy waits for `begin`.
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})

import pbl_pipeline.pipeline
import pbl_workers.loop
import pbl_workers.process
import pbl_workers.selftest

gc.freeze()  # their pages stay shared: the collector writes to each object that it looks at
