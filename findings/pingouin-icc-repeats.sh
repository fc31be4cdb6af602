#!/usr/bin/env bash
# pingouin's reliability of one rating is that of a mean if a rater rated more than once, and gaps in repeats do not count.
#
# Seen 2026-11-29: pingouin 0.7.0, pandas 3.1.1, numpy 2.4.6.
# Behaviour: `intraclass_corr` takes the mean of all rows of a target and rater. With nine walks a visit, ICC(A,1), by its
#   documentation that of one rating, is 0.9 where one walk has 0.5. Walks that are missing pass the default
#   `nan_policy="raise"`, and means of one and of nine walks are mixed; only a visit without any walk is refused.
# Matters: tables of gait have a row a walk or a cycle. The error of measurement, and the change that counts as real, look
#   too small by the root of the number of repeats, beside studies that have one.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install pingouin==0.7.0 numpy==2.4.6 pandas==3.1.1
observe venv <<'PY'
import numpy as np
import pandas as pd
import pingouin

random = np.random.default_rng(1)
people, visits, walks = 400, 2, 9
# Variances of a person and of a walk are equal: one walk has a reliability of 0.5, the mean of nine of 0.9.
values = random.normal(size=(people, 1, 1)) + random.normal(size=(people, visits, walks))
rows = [(*at, values[at]) for at in np.ndindex(values.shape)]
table = pd.DataFrame(rows, columns=["person", "visit", "walk", "speed"])


def reliability(case, part):
    try:
        found = pingouin.intraclass_corr(part, targets="person", raters="visit", ratings="speed").set_index("Type")
    except ValueError:
        print(f"{case}: refused")
        return
    row = found.loc["ICC(A,1)"]
    print(f"{case}: ICC(A,1) {row.ICC:.1f}, of {row.df1 + 1:.0f} people")


reliability("one walk a visit", table[table.walk == 0])
reliability("nine walks a visit", table)
gaps = table.copy()
gaps.loc[(gaps.walk > 0) & (gaps.person < 200), "speed"] = np.nan
reliability("nine walks, eight of them missing for half of the people", gaps)
gaps.loc[(gaps.person == 0) & (gaps.visit == 0), "speed"] = np.nan
reliability("the same, and a visit without a walk", gaps)
PY
expect <<'SEEN'
one walk a visit: ICC(A,1) 0.5, of 400 people
nine walks a visit: ICC(A,1) 0.9, of 400 people
nine walks, eight of them missing for half of the people: ICC(A,1) 0.6, of 400 people
the same, and a visit without a walk: refused
SEEN
