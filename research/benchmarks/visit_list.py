"""Cost of the list of visits of `pbl web`.

    python -m research.benchmarks.visit_list                 # 50,000 visits of 10,000 people, in a separate database

The rows are copies of one recorded visit with other days, roles, indices and outcomes; the questions are those of the
page. Bars: first page 300 ms (median of 50), any filter 500 ms, at the server.
"""

from __future__ import annotations

import dataclasses
import datetime
import statistics
import time
from collections.abc import Iterator
from typing import Any

import click

from research.benchmarks import workers as queue

#: Visits of a person.
VISITS_EACH = 5


def recordings(n_visits: int) -> Iterator[Any]:
    """Numbered recordings of the queue's benchmark, five visits to a person."""
    for i, one in enumerate(queue.recordings(0, n_visits * queue.EACH)):
        visit = i // queue.EACH
        label = f"{datetime.date(2020, 1, 1) + datetime.timedelta(days=visit % 2000)}-{visit % VISITS_EACH}"
        one.visit = dataclasses.replace(one.visit, subject=f"S{visit // VISITS_EACH:07d}", session_label=label)
        yield one


def spread(n_visits: int) -> None:
    """Give the copied visits days, roles, a cohort, indices and outcomes that differ."""
    from pbl_schemas import gdi, lab, qc, session, study, tracking

    query = session.Session.connection.query
    sessions, members = session.Session.full_table_name, study.CohortMember.full_table_name
    query(f"UPDATE {sessions} SET session_date = DATE('2020-01-01') + INTERVAL (session_id %% 2000) DAY")
    roles = "ELT(1 + session_id %% 5, 'pre', '6_weeks', '3_months', '6_months', '12_months')"
    visits = study.Visit.full_table_name
    query(f"INSERT IGNORE INTO {visits} (session_id, visit_role, intervention, assistive_device, orthosis, visit_note)"
          f" SELECT session_id, {roles}, '', '', '', '' FROM {sessions}")  # fmt: skip
    study.Cohort.insert([{"cohort": "spine"}, {"cohort": "hip"}], skip_duplicates=True)
    for cohort, of_ten in (("spine", 4), ("hip", 7)):
        query(f"INSERT IGNORE INTO {members} (cohort, subject, member_included, member_group, member_reason)"
              f" SELECT '{cohort}', subject, 1, '', '' FROM {lab.Subject.full_table_name}"
              f" WHERE MOD(CRC32(subject), 10) < {of_ten}")  # fmt: skip
    index = "session_gdi = 60 + MOD(CRC32(fit_set), 400) / 10, session_gdi_sd = 3, session_gdi_minimal_change = 7"
    query(f"UPDATE {gdi.SessionGdi.full_table_name} SET {index}")
    outcome = "ELT(1 + MOD(CRC32(fit_set), 4), 'PASS', 'WARN', 'FAIL', 'EMPTY')"
    query(f"UPDATE {qc.SessionQc.full_table_name} SET qc_outcome = {outcome}, qc_worst = 'residual_3d_cm'")
    query(f"UPDATE {tracking.SubjectChoice.full_table_name} SET choice_status = 'NEEDS_CHOICE'"
          " WHERE video_id %% 997 = 0")  # fmt: skip


def filters() -> dict[str, Any]:
    """Return the measured filters by name."""
    from pbl_schemas.reading.visit_list import OUTCOMES, STATES, Filter

    day = datetime.date
    found = {"everything": Filter(), "a person's code": Filter(search="s000123"), "a label": Filter(search="2024-0")}
    found |= {
        "nothing found": Filter(search="nobody"),
        "a cohort": Filter(cohort="spine"),
        "a role": Filter(role="pre"),
    }
    found |= {f"quality {o}": Filter(quality=o) for o in OUTCOMES}
    found |= {f"state {s}": Filter(state=s) for s in STATES}
    found["a month"] = Filter(first_day=day(2024, 3, 1), last_day=day(2024, 3, 31))
    everything = Filter("s0", "spine", "pre", "WARN", "computed", day(2020, 6, 1), day(2025, 1, 1))
    return found | {"all filters at once": everything}


def median_ms(function: Any, n: int) -> float:
    """Median time of calls (ms)."""
    seconds = []
    for _ in range(n):
        t = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - t)
    return 1000 * statistics.median(seconds)


@click.command()
@click.option("--visits", default=50_000, show_default=True)
@click.option("--repeats", default=50, show_default=True)
def main(visits: int, repeats: int) -> None:
    """Make the visits, ask for pages, print the figures."""
    from pbl_schemas.reading.visit_list import Filter, visit_page
    from research.benchmarks.many_recordings import register_many

    with queue.installation():
        register_many(list(recordings(visits))[: queue.EACH])
        queue.work(1)  # the visit whose rows are copied
        register_many(list(recordings(visits))[queue.EACH :])
        queue.copy_results(0, visits)
        spread(visits)
        first = visit_page(Filter())
        assert first.total == visits
        queue.say("first page of the list, median", median_ms(lambda: visit_page(Filter()), repeats), "ms", "bar 300")
        for name, wanted in filters().items():
            page = visit_page(wanted)
            ms = median_ms(lambda w=wanted: visit_page(w), max(3, repeats // 5))
            queue.say(f"{name} ({page.total} visits)", ms, "ms", "bar 500")
        after, n = first.after, 1
        while after is not None and n < visits // 100:  # to the middle of the list
            after, n = visit_page(Filter(), after, size=5000).after, n + 100
        queue.say("a page in the middle", median_ms(lambda: visit_page(Filter(), after), repeats // 5), "ms", "bar 500")


if __name__ == "__main__":
    main()
