#!/usr/bin/env bash
# DataJoint stores the missing values of a masked array as 1e20, and a time with a zone as another moment.
#
# Seen 2026-11-29: datajoint 2.3.5, numpy 2.4.6.
# Behaviour: the blob codec packs a masked array without its mask; a missing float comes back as 1e20, a missing whole
#   number as 999999. A datetime with a zone comes back with the same hour and no zone. Types such as float16
#   and timedelta are refused.
# Matters: the package netCDF4 returns masked arrays, and programs that mark lost samples may. Means of what
#   was fetched are then of the order of 1e20. Store `array.filled(nan)`, and times in UTC.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install datajoint==2.3.5 pymysql==1.2.4 numpy==2.4.6
observe venv <<'PY'
import datetime

import numpy as np
from datajoint import DataJointError, blob


def seen(case, value):
    try:
        back = blob.unpack(blob.pack(value))
    except DataJointError:
        print(f"{case}: refused")
    else:
        print(f"{case}:", back.tolist() if isinstance(back, np.ndarray) else back)


lost = [False, True, False]
seen("angles with a NaN", np.array([12.5, np.nan, 14.0]))
seen("angles with a mask", np.ma.array([12.5, 13.0, 14.0], mask=lost))
seen("steps with a mask", np.ma.array([3, 4, 5], mask=lost))
seen("half precision", np.array([12.5], np.float16))
seen("duration", datetime.timedelta(seconds=1.5))
zone = datetime.timezone(datetime.timedelta(hours=2))
seen("10:00 at UTC+2", datetime.datetime(2026, 3, 1, 10, tzinfo=zone))
seen("the same in UTC", datetime.datetime(2026, 3, 1, 10, tzinfo=zone).astimezone(datetime.UTC))
PY
expect <<'SEEN'
angles with a NaN: [12.5, nan, 14.0]
angles with a mask: [12.5, 1e+20, 14.0]
steps with a mask: [3, 999999, 5]
half precision: refused
duration: refused
10:00 at UTC+2: 2026-03-01 10:00:00
the same in UTC: 2026-03-01 08:00:00
SEEN
