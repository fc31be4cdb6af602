#!/usr/bin/env bash
# The package gait-profile-score takes the mean of the angles' scores, where the score is their root mean square.
#
# Seen 2026-11-30: gait-profile-score 1.0.2, numpy 2.4.6, pandas 3.1.1, scipy 1.17.1, matplotlib 3.11.2.
# Behaviour: its documentation names Baker et al. 2009, Gait & Posture 30:265-269, whose Gait Profile Score is the root mean
#   square of the angles' scores, the pelvis counted once in the score of the person. `calculateGPS` takes the mean of nine
#   angles a side, and of all 18. `referenceGroup` raises with pandas 2 and later.
# Matters: one bad joint counts less: a knee 30 degrees off, all else 4, scores 6.9 instead of 10.7. Published norms and
#   smallest relevant changes (1.6 degrees) are those of the root mean square.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install gait-profile-score==1.0.2 numpy==2.4.6 pandas==3.1.1 scipy==1.17.1 matplotlib==3.11.2
observe venv <<'PY'
import json

import numpy as np
from gpscalculator import calculateGPS, exampleInputData, referenceGroup

names = exampleInputData().kinematicVariables()
norm = {name: np.zeros(51) for name in names}
for what, changed in (("all angles 4 deg off", {}), ("left knee 30", {"Knee Flexion Left": 30}),
                      ("pelvis tilted by 20", {"Pelvic Tilt Left": 20, "Pelvic Tilt Right": 20})):
    person = {name: np.full(51, float(changed.get(name, 4))) for name in names}
    scores = calculateGPS(norm, person).gps
    left = [scores[name] for name in names if name.endswith("Left")]
    once = left + [scores[name] for name in names if name.endswith("Right") and not name.startswith("Pelvic")]
    print(f"{what}: left {scores['GPS Left']:.1f}, person {scores['GPS']:.1f};",
          f"root mean square {np.sqrt(np.mean(np.square(left))):.1f}, {np.sqrt(np.mean(np.square(once))):.1f}")
for i in range(2):
    with open(f"person{i}.json", "w") as file:
        json.dump({name: [float(i)] * 51 for name in names}, file)
try:
    referenceGroup().processGroupData(["person0.json", "person1.json"])
    print("reference group: made")
except AttributeError as error:
    print(f"reference group: {type(error).__name__}")
PY
expect <<'SEEN'
all angles 4 deg off: left 4.0, person 4.0; root mean square 4.0, 4.0
left knee 30: left 6.9, person 5.4; root mean square 10.7, 8.7
pelvis tilted by 20: left 5.8, person 5.8; root mean square 7.7, 6.4
reference group: AttributeError
SEEN
