#!/usr/bin/env bash
# gaitalytics detects other gait events in the same walk when the person walks in another direction of the room.
#
# Seen 2026-11-28: gaitalytics 0.2.2, pyomeca 2026.0.2, ezc3d 1.7.2, pandas 3.1.1.
# Behaviour: `detect_events` turns the markers by the unsigned angle between the direction of walking and x, so that it
#   turns the wrong way if the person walks towards positive y, and mirrors the feet, but not the sacrum, about the
#   room's origin. One walk along y is then off by half a cycle, the contacts of one foot becoming those of the other;
#   at 45 and 135 deg it has hundreds of events. No error or warning.
# Matters: events, and with them all cycles, are wrong without a word in laboratories whose walkway is not along x.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install gaitalytics==0.2.2 pyomeca==2026.0.2 ezc3d==1.7.2 pandas==3.1.1 numpy==2.4.6
observe venv <<'PY'
import json
from pathlib import Path
import ezc3d, numpy as np
from gaitalytics import api

NAMES = {"l_heel": "LHEE", "r_heel": "RHEE", "l_toe": "LTOE", "r_toe": "RTOE"}
NAMES |= {"l_ant_hip": "LASI", "r_ant_hip": "RASI", "sacrum": "SACR"}
Path("config.yaml").write_text(json.dumps({"analysis": {"markers": ["SACR"]}, "mapping": {"markers": NAMES}}))
config = api.load_config("config.yaml")


def walk(heading_deg):
    """6 s, 1.2 m/s, a stride each 1.1 s; the left heel is foremost at 1.1, 2.2, ... s."""
    time, turn = np.arange(600) / 100, np.radians(heading_deg)
    ahead, left = np.array([np.cos(turn), np.sin(turn), 0]), np.array([-np.sin(turn), np.cos(turn), 0])
    pelvis = np.array([2000.0, 3000.0, 0]) + 1200 * time[:, None] * ahead
    points = {"LASI": (100, 120, 950), "RASI": (100, -120, 950), "SACR": (-80, 0, 970)}
    made = {name: pelvis + a * ahead + b * left + [0, 0, z] for name, (a, b, z) in points.items()}
    for side, across, phase in (("L", 100, 0.0), ("R", -100, 0.5)):
        swing = 330 * np.cos(2 * np.pi * (time / 1.1 - phase))[:, None] * ahead
        for name, a, z in (("HEE", -60, 50), ("TOE", 140, 40)):
            made[side + name] = pelvis + swing + a * ahead + across * left + [0, 0, z]
    file = ezc3d.c3d()
    for group, label, unit in (("POINT", list(made), ["mm"]), ("ANALOG", ["EMG"], ["V"])):
        parameters = file["parameters"][group]
        parameters["RATE"]["value"], parameters["LABELS"]["value"], parameters["UNITS"]["value"] = [100.0], label, unit
    file["data"]["points"] = np.concatenate([np.stack(list(made.values())).transpose(2, 0, 1), np.ones((1, 7, 600))])
    file["data"]["analogs"] = np.zeros((1, 1, 600))
    for key, value in (("LABELS", ["Foot Strike"] * 3), ("CONTEXTS", ["Left"] * 3), ("ICON_IDS", [1] * 3)):
        file.add_parameter("EVENT", key, value)
    file.add_parameter("EVENT", "TIMES", np.zeros((2, 3)))
    file.write("walk.c3d")
    return api.load_c3d_trial("walk.c3d", config)


for heading in (0, 45, 90, 135, 180, 270):
    events = api.detect_events(walk(heading), config)
    left = events[(events.label == "Foot Strike") & (events.context == "Left")].time.round(2).tolist()
    print(f"{heading} deg:", left if len(left) < 10 else "more than 50" if len(left) > 50 else len(left))
PY
expect <<'SEEN'
0 deg: [1.1, 2.2, 3.3, 4.4, 5.5]
45 deg: more than 50
90 deg: [0.55, 1.65, 2.75, 3.85, 4.95]
135 deg: more than 50
180 deg: [1.1, 2.2, 3.3, 4.4, 5.5]
270 deg: [1.1, 2.2, 3.3, 4.4, 5.5]
SEEN
