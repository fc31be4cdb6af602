#!/usr/bin/env bash
# sleap-io reads a DeepLabCut file of predictions without an error and returns no frame.
#
# Seen 2026-11-28: sleap-io 0.9.5.
# Behaviour: DeepLabCut's CSV of annotations and that of an analysed video have the same three lines of header. sleap-io
#   recognises both as DeepLabCut's and takes the names of the points, but only annotations name pictures in their first
#   column; rows that have a frame's number there are dropped, without an error or a warning.
# Matters: predictions that pose programs export as DeepLabCut's CSV look empty. Check the number of frames.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install sleap-io==0.9.5 numpy==2.4.6
observe venv <<'PY'
import csv, warnings
import sleap_io

with open("walkDLC_resnet50.csv", "w", newline="") as file:
    sheet = csv.writer(file)
    sheet.writerow(["scorer", *["network"] * 6])
    sheet.writerow(["bodyparts", *["heel"] * 3, *["toe"] * 3])
    sheet.writerow(["coords", *["x", "y", "likelihood"] * 2])
    for i in range(5):
        sheet.writerow([i, 10 + i, 20, 0.9, 30 + i, 21, 0.8])
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    labels = sleap_io.load_file("walkDLC_resnet50.csv")
print("5 frames written; points", labels.skeleton.node_names, "| frames", len(labels), "| warnings", len(told))
PY
expect <<'SEEN'
5 frames written; points ['heel', 'toe'] | frames 0 | warnings 0
SEEN
