#!/usr/bin/env bash
# pingouin's t-test reports Cohen's d without its sign: a decline has the effect of an improvement.
#
# Seen 2026-11-30: pingouin 0.7.0, numpy 2.4.6, pandas 3.1.1.
# Behaviour: `ttest` takes the absolute value of d, which its documentation calls "Cohen d effect size"; `compute_effsize`
#   and `pairwise_tests` of the same values keep the sign.
# Matters: in a table of effects by measure one cannot see what became worse, and the mean over groups of which one
#   declines is wrong.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install pingouin==0.7.0 numpy==2.4.6 pandas==3.1.1
observe venv <<'PY'
import numpy as np
import pandas as pd
import pingouin

speed = np.array([1.0, 1.1, 0.9, 1.2, 1.05, 0.95, 1.15, 1.0])
change = np.array([0.1, 0.05, 0.12, 0.08, 0.15, 0.02, 0.11, 0.09])
for what, after in (("faster", speed + change), ("slower", speed - change)):
    for paired in (True, False):
        test = pingouin.ttest(after, speed, paired=paired).iloc[0]
        persons = [*range(8)] * 2 if paired else [*range(16)]
        table = pd.DataFrame({"speed": np.r_[after, speed], "visit": ["after"] * 8 + ["before"] * 8, "person": persons})
        how = {"within": "visit", "subject": "person"} if paired else {"between": "visit"}
        pairs = pingouin.pairwise_tests(table, dv="speed", effsize="cohen", **how).iloc[0]
        size = pingouin.compute_effsize(after, speed, paired=paired, eftype="cohen")
        print(f"{what}, {'paired' if paired else 'unpaired'}: t {test['T']:+.1f}, ttest's d {test['cohen_d']:+.2f},",
              f"pairwise_tests' {pairs['cohen']:+.2f}, compute_effsize's {size:+.2f}")
PY
expect <<'SEEN'
faster, paired: t +6.3, ttest's d +0.85, pairwise_tests' +0.85, compute_effsize's +0.85
faster, unpaired: t +1.7, ttest's d +0.85, pairwise_tests' +0.85, compute_effsize's +0.85
slower, paired: t -6.3, ttest's d +0.86, pairwise_tests' -0.86, compute_effsize's -0.86
slower, unpaired: t -1.7, ttest's d +0.86, pairwise_tests' -0.86, compute_effsize's -0.86
SEEN
