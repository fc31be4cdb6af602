#!/usr/bin/env bash
# spm1d.util.interp stretches a curve over the gait cycle: it samples up to one sample behind the end, and holds the last value.
#
# Seen 2026-11-30: spm1d 0.4.55, numpy 2.4.6, scipy 1.17.1, matplotlib 3.11.2.
# Behaviour: of N samples that span 0 to 100 % the nodes lie at 0 to N samples instead of 0 to N - 1. A curve that already
#   has 101 values is changed by `interp(y, 101)`; one of 34 samples (a stride at 30 Hz) runs 3 % ahead and stands still
#   at the end. The docstring says "Simple linear interpolation to n values".
# Matters: it is the function of the package for curves of unequal length. One walk at 30 and at 120 Hz becomes two
#   different ones, and the test behind it finds that they differ.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install spm1d==0.4.55 numpy==2.4.6 scipy==1.17.1 matplotlib==3.11.2
observe venv <<'PY'
import numpy as np
import spm1d

percent = np.linspace(0, 100, 101)
print(f"101 values to 101: changed by up to {abs(spm1d.util.interp(percent, 101) - percent).max():.2f} %")


def knee(at, height):
    return 8 + 14 * height * np.exp(-(((at - 14) / 8) ** 2)) + 52 * height * np.exp(-(((at - 72) / 11) ** 2))


for n in (34, 51, 133):
    at = np.linspace(0, 100, n)
    nodes = spm1d.util.interp(at, 101)
    held = int((nodes == nodes[-1]).sum())
    wrong = abs(spm1d.util.interp(knee(at, 1), 101) - np.interp(percent, at, knee(at, 1))).max()
    print(f"{n} samples: node 60 holds {nodes[60]:.1f} %, the last {held} nodes are equal, a knee off by {wrong:.1f} deg")
rng = np.random.default_rng(0)
heights = 1 + 0.1 * rng.standard_normal(12)
for how in ("spm1d.util.interp", "np.interp"):
    curves = {}
    for n in (34, 133):
        at = np.linspace(0, 100, n)
        walks = [knee(at, h) + np.interp(at, [0, 25, 50, 75, 100], rng.standard_normal(5)) for h in heights]
        curves[n] = spm1d.util.interp(walks, 101) if how[0] == "s" else np.array([np.interp(percent, at, w) for w in walks])
    test = spm1d.stats.ttest_paired(curves[34], curves[133]).inference(0.05)
    print(f"twelve walks at 30 and 120 Hz, {how}: {'differ' if test.h0reject else 'do not differ'}")
PY
expect <<'SEEN'
101 values to 101: changed by up to 0.99 %
34 samples: node 60 holds 61.8 %, the last 3 nodes are equal, a knee off by 9.6 deg
51 samples: node 60 holds 61.2 %, the last 2 nodes are equal, a knee off by 6.3 deg
133 samples: node 60 holds 60.5 %, the last 1 nodes are equal, a knee off by 2.4 deg
twelve walks at 30 and 120 Hz, spm1d.util.interp: differ
twelve walks at 30 and 120 Hz, np.interp: do not differ
SEEN
