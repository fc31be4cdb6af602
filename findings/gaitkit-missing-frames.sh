#!/usr/bin/env bash
# gaitkit finds no event with its default method if one frame of a C3D lacks its points, without an error.
#
# Seen 2026-11-28: gaitkit 1.5.0, ezc3d 1.7.2.
# Behaviour: `load_c3d` keeps missing points as NaN. If one of 600 frames lacks them, the methods `bike` (the default)
#   and `dgei` return no event of the whole walk, `zeni` those that it finds without the gap.
# Matters: recordings have gaps, and begin before the person is in view; no event looks like no gait.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install --no-binary gaitkit gaitkit==1.5.0 ezc3d==1.7.2 numpy==2.4.6 # gaitkit has no wheel: it is built
observe venv <<'PY'
import ezc3d, gaitkit, numpy as np

time = np.arange(600) / 100
pelvis = np.column_stack([1200 * time, 0 * time, 0 * time])
made = {"LASI": (100, 120, 950), "RASI": (100, -120, 950), "SACR": (-80, 0, 970)}
made = {name: pelvis + place for name, place in made.items()}
for side, across, phase in (("L", 100, 0.0), ("R", -100, 0.5)):
    turn = 2 * np.pi * (time / 1.1 - phase)
    swing = np.column_stack([330 * np.cos(turn), 0 * time, 60 * np.clip(-np.sin(turn), 0, 1)])
    for name, part, ahead, up in (("KNE", 0.5, 20, 480), ("ANK", 1, 0, 90), ("HEE", 1, -60, 50), ("TOE", 1, 140, 40)):
        made[side + name] = pelvis + part * swing + [ahead, across, up]
    for name, middle, swing_deg in (("Hip", 12, 20), ("Knee", 30, 28), ("Ankle", 0, 10)):
        made[f"{side}{name}Angles"] = np.column_stack([middle + swing_deg * np.cos(turn), 0 * time, 0 * time])
file = ezc3d.c3d()
point = file["parameters"]["POINT"]
point["RATE"]["value"], point["LABELS"]["value"], point["UNITS"]["value"] = [100.0], list(made), ["mm"]
points = np.stack(list(made.values())).transpose(2, 0, 1)
file["data"]["points"] = np.concatenate([points, np.ones((1, *points.shape[1:]))])
for missing in (0, 1):
    file["data"]["points"][:3, :, 300 : 300 + missing] = np.nan
    file.write("walk.c3d")
    trial = gaitkit.load_c3d("walk.c3d")
    for method in ("bike", "dgei", "zeni"):
        found = gaitkit.detect(trial, method=method)
        print(f"{missing} of 600 frames missing, {method}: {len(found.left_hs)} contacts of the left foot")
PY
expect <<'SEEN'
0 of 600 frames missing, bike: 6 contacts of the left foot
0 of 600 frames missing, dgei: 5 contacts of the left foot
0 of 600 frames missing, zeni: 5 contacts of the left foot
1 of 600 frames missing, bike: 0 contacts of the left foot
1 of 600 frames missing, dgei: 0 contacts of the left foot
1 of 600 frames missing, zeni: 5 contacts of the left foot
SEEN
