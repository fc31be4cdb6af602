#!/usr/bin/env bash
# statsmodels draws Bland and Altman's limits of agreement with the standard deviation that divides by n: they are too narrow.
#
# Seen 2026-11-30: statsmodels 0.15.0, pingouin 0.7.0, numpy 2.4.6, matplotlib 3.11.2.
# Behaviour: `mean_diff_plot` names Bland and Altman 1986, whose limits are mean -+ 1.96 sd with n - 1. Its own are narrower
#   by the root of (n - 1) / n, 6 % with eight persons; pingouin's of the same values are not. Its documentation calls them
#   "95% confidence intervals for the means of the differences", which they are not either.
# Matters: a method agrees better than it does, the fewer the persons the more, and its figures cannot be compared.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install statsmodels==0.15.0 pingouin==0.7.0 numpy==2.4.6 matplotlib==3.11.2
observe venv <<'PY'
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pingouin
import statsmodels.api as sm


def half_width(draw):
    """Half the distance of the outermost horizontal lines of a new plot."""
    axes = plt.figure().add_subplot()
    draw(axes)
    heights = [line.get_ydata()[0] for line in axes.lines if len(line.get_ydata()) == 2 and np.ptp(line.get_ydata()) == 0]
    return (max(heights) - min(heights)) / 2


rng = np.random.default_rng(0)
for n in (5, 8, 12, 100):
    video = 1.2 + 0.2 * rng.standard_normal(n)
    mat = video + 0.05 * rng.standard_normal(n)
    limit = 1.96 * (video - mat).std(ddof=1)
    drawn = {
        "statsmodels": half_width(lambda axes: sm.graphics.mean_diff_plot(video, mat, ax=axes)),
        "pingouin": half_width(lambda axes: pingouin.plot_blandaltman(video, mat, ax=axes, confidence=None)),
    }
    print(f"{n} persons, as a fraction of 1.96 sd:", ", ".join(f"{name} {x / limit:.3f}" for name, x in drawn.items()))
PY
expect <<'SEEN'
5 persons, as a fraction of 1.96 sd: statsmodels 0.894, pingouin 1.000
8 persons, as a fraction of 1.96 sd: statsmodels 0.935, pingouin 1.000
12 persons, as a fraction of 1.96 sd: statsmodels 0.957, pingouin 1.000
100 persons, as a fraction of 1.96 sd: statsmodels 0.995, pingouin 1.000
SEEN
