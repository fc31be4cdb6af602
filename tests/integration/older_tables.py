"""Tables as older releases had them: each function takes one migration back, with rows as that release wrote them."""

import json
from typing import Any

#: Databases of before 0.2.0 recorded no migrations when their tables were new.
NOT_RECORDED = "DROP TABLE pbl_lab.`~migrations`"

#: What shipped of instruments before migration 0006.
SHIPPED_BEFORE = {
    "mJOA": {
        "minimal_change_source": "ROC analysis, degenerative cervical myelopathy 12 months after surgery, depends on "
        "severity: Tetreault et al. 2015, Spine 40:1653-1659"
    },
    "BBS": {
        "instrument_source": "the scale: Berg et al. 1992, Can J Public Health 83 Suppl 2:S7-11",
        "instrument_classes": "0 high risk; 21 medium risk; 41 low risk",
    },
    "mRS": {"instrument_source": "the scale: van Swieten et al. 1988, Stroke 19:604-607", "instrument_high": 6},
}

#: The tables of results as they were before migration 0001.
WITHOUT_SESSION = [
    *(f"pbl_{t}" for t in ("fit.__session_fit", "gait.__gait_events", "gait.__gait_cycle", "gait.__spatiotemporal")),
    *(f"pbl_{t}" for t in ("gdi.__g_d_i", "gdi.__session_gdi", "qc.__session_qc", "validation.__kinematic_error")),
]

#: The tables of corrections before migration 0004.
HAND_EVENTS = (
    "CREATE TABLE pbl_gait.hand_events (video_id INT NOT NULL PRIMARY KEY, hand_from VARCHAR(48) NOT NULL,"
    " hand_changed SMALLINT NOT NULL, hand_tracking VARCHAR(48), hand_person SMALLINT, hand_by VARCHAR(64) NOT NULL,"
    " hand_at DATETIME NOT NULL, FOREIGN KEY (video_id) REFERENCES pbl_video.video (video_id) ON UPDATE CASCADE,"
    " FOREIGN KEY (hand_from) REFERENCES pbl_gait.`#gait_event_method` (gait_method) ON UPDATE CASCADE)",
    "CREATE TABLE pbl_gait.hand_events__event (video_id INT NOT NULL, hand_no SMALLINT NOT NULL,"
    " hand_time DOUBLE NOT NULL, hand_side ENUM('left','right') NOT NULL,"
    " hand_kind ENUM('foot_down','foot_up') NOT NULL, hand_probability DOUBLE, PRIMARY KEY (video_id, hand_no),"
    " FOREIGN KEY (video_id) REFERENCES pbl_gait.hand_events (video_id) ON UPDATE CASCADE)",
    "INSERT INTO pbl_gait.hand_events SELECT video_id, gait_method, correction_changed, correction_tracking,"
    " correction_person, correction_by, correction_at FROM pbl_gait.event_correction",
    "INSERT INTO pbl_gait.hand_events__event SELECT video_id, corrected_no, corrected_time, corrected_side,"
    " corrected_kind, corrected_probability FROM pbl_gait.event_correction__event",
)


def undo_0001(cursor: Any) -> None:
    """Take the session out of the rows of results."""
    for table in WITHOUT_SESSION:
        cursor.execute(
            "SELECT constraint_name FROM information_schema.key_column_usage WHERE CONCAT(table_schema, '.', "
            "table_name) = %s AND column_name = 'session_id' AND referenced_table_name IS NOT NULL",
            (table,),
        )
        ((key,),) = cursor.fetchall()
        cursor.execute(f"ALTER TABLE {table} DROP FOREIGN KEY `{key}`, DROP COLUMN session_id")
        schema, name = table.split(".")
        cursor.execute(
            f"DELETE FROM {schema}.`~lineage` WHERE table_name = %s AND attribute_name = 'session_id'", (name,)
        )


def undo_0002(cursor: Any) -> None:
    """Make the kinds of decisions a list of the table again."""
    cursor.execute("SELECT DISTINCT decision_what FROM pbl_review.decision")
    kinds = ",".join(f"'{kind}'" for kind in sorted({"person", "check", *(row[0] for row in cursor.fetchall())}))
    column = (
        f"decision_what ENUM({kinds}) NOT NULL COMMENT ':enum({kinds.replace(chr(39), chr(39) * 2)}):who is measured'"
    )
    cursor.execute(f"ALTER TABLE pbl_review.decision MODIFY COLUMN {column}")


def undo_0003(cursor: Any) -> None:
    """Forget the height that a fit was told."""
    cursor.execute("ALTER TABLE pbl_fit.__session_fit DROP COLUMN fit_height")


def undo_0004(cursor: Any) -> None:
    """Make the one corrected recording's results those of a method by hand, beside those of the detected events."""
    cursor.execute("SELECT gait_method FROM pbl_gait.event_correction")
    ((method,),) = cursor.fetchall()
    cursor.execute("SET foreign_key_checks = 0")
    for statement in HAND_EVENTS:
        cursor.execute(statement)
    cursor.execute(
        "INSERT INTO pbl_gait.`#gait_event_method` VALUES ('by-hand-v1', 'by-hand', 1, %s, 'f8f1e2d3c4b5a697')",
        (json.dumps({"automatic": method, "automatic_hash": "0" * 16}),),
    )
    cursor.execute("INSERT INTO pbl_gait.gait_plan SELECT session_id, 'by-hand-v1' FROM pbl_gait.gait_plan")
    cursor.execute("ALTER TABLE pbl_gait.__gait_cycle DROP FOREIGN KEY __gait_cycle_ibfk_3, DROP COLUMN correction_no")
    cursor.execute("ALTER TABLE pbl_gdi.__session_gdi DROP COLUMN session_corrected")
    cursor.execute(
        "DROP TABLE pbl_gdi.__session_gdi__trial, pbl_gait.event_correction__event, pbl_gait.event_correction"
    )
    cursor.execute(
        "SELECT CONCAT(table_schema, '.', table_name), GROUP_CONCAT(column_name ORDER BY ordinal_position)"
        " FROM information_schema.columns WHERE table_schema IN ('pbl_gait', 'pbl_gdi', 'pbl_qc')"
        " AND table_name LIKE '\\_\\_%%' GROUP BY 1 HAVING SUM(column_name = 'gait_method')"
    )
    for table, columns in cursor.fetchall():
        by_hand = columns.replace("gait_method", "'by-hand-v1'")
        cursor.execute(f"INSERT INTO {table} SELECT {by_hand} FROM {table}")
    cursor.execute("UPDATE pbl_gait.__gait_events SET events_detector = 'by-hand' WHERE gait_method = 'by-hand-v1'")
    # Those of the detected events have other numbers.
    for table, column in (("gait.__spatiotemporal", "stance"), ("gdi.__session_gdi", "session_stance")):
        cursor.execute(f"UPDATE pbl_{table} SET {column} = 1.5 WHERE gait_method = %s", (method,))
    cursor.execute("UPDATE pbl_gdi.__g_d_i__cycle SET cycle_z = 1.5 WHERE gait_method = %s", (method,))


def undo_0005(cursor: Any, video_id: int) -> None:
    """Take the foreign key from Tracking to VideoInfo away, and the VideoInfo of a video whose Tracking stays."""
    cursor.execute(
        "SELECT constraint_name FROM information_schema.key_column_usage WHERE table_schema = 'pbl_tracking'"
        " AND table_name = '__tracking' AND referenced_table_name = '__video_info'"
    )
    ((key,),) = cursor.fetchall()
    cursor.execute(f"ALTER TABLE pbl_tracking.__tracking DROP FOREIGN KEY `{key}`")
    cursor.execute("DELETE FROM pbl_video.__video_info WHERE video_id = %s", (video_id,))


def undo_0006(cursor: Any) -> None:
    """Give the instruments what shipped of them before."""
    table = "pbl_study.`#clinical_instrument`"
    cursor.execute(f"ALTER TABLE {table} DROP COLUMN minimal_change_classes")
    for name, columns in SHIPPED_BEFORE.items():
        for column, value in columns.items():
            cursor.execute(f"UPDATE {table} SET {column} = %s WHERE instrument = %s", (value, name))


def undo_0007(cursor: Any) -> None:
    """Forget whether errors are normally distributed."""
    cursor.execute("ALTER TABLE pbl_validation.__kinematic_error__joint DROP COLUMN joint_normal_p")


def undo_0008(cursor: Any) -> None:
    """Forget the errors of a visit's measures."""
    for column in ("session_measure_error", "session_measure_minimal_change"):
        cursor.execute(f"ALTER TABLE pbl_gdi.__session_gdi__measure DROP COLUMN {column}")


def undo_0009(cursor: Any) -> None:
    """Forget whether the feet show that a cycle of odd length is not one stride."""
    cursor.execute("ALTER TABLE pbl_gait.__gait_cycle__cycle DROP COLUMN cycle_length_unproven")


def undo_0010(cursor: Any) -> None:
    """Forget the unshrunk index."""
    for table, prefix in (("__g_d_i", "gdi"), ("__session_gdi", "session_gdi")):
        for column in (f"{prefix}_unshrunk", f"{prefix}_unshrunk_sd"):
            cursor.execute(f"ALTER TABLE pbl_gdi.{table} DROP COLUMN {column}")


def undo_0012(cursor: Any) -> None:
    """Forget the segments of wearable sensors."""
    cursor.execute("ALTER TABLE pbl_video.wearable_imu DROP COLUMN imu_rate, DROP COLUMN imu_segments")


def undo_0013(cursor: Any) -> None:
    """Forget why the solvers of fits ended."""
    cursor.execute("ALTER TABLE pbl_fit.__session_fit DROP COLUMN fit_result")


def undo_0014(cursor: Any) -> None:
    """Forget which depth recordings are read, and their scale."""
    cursor.execute("ALTER TABLE pbl_video.depth_video DROP COLUMN depth_read, DROP COLUMN depth_scale")


def undo_0015(cursor: Any) -> None:
    """Forget the use of GPUs."""
    cursor.execute("ALTER TABLE pbl_worker.worker DROP COLUMN worker_gpus")


def undo_0017(cursor: Any) -> None:
    """Forget how wearable sensors sit."""
    cursor.execute("ALTER TABLE pbl_video.wearable_imu DROP COLUMN imu_mounts")


def undo_0016(cursor: Any) -> None:
    """Narrow the columns of reasons."""
    before = {"cycle_lengths_missing": 150, "curves_missing": 100, "forces_missing": 100}
    for table, names in {
        "pbl_keypoints.__keypoints": ("camera_source", "phone_log"),
        "pbl_gait.__gait_cycle__cycle": ("cycle_lengths_missing", "curves_missing"),
        "pbl_gait.__spatiotemporal__measure": ("measure_missing",),
        "pbl_gdi.__session_gdi__measure": ("session_measure_missing",),
        "pbl_kinetics.__kinetics": ("forces_reason",),
        "pbl_kinetics.__kinetics__trial": ("trial_forces_reason",),
        "pbl_kinetics.__kinetics__cycle": ("forces_missing",),
        "pbl_kinetics.__kinetics__measure": ("force_missing",),
        "pbl_privacy.__deidentified": ("deidentified_reason",),
    }.items():
        for name in names:
            cursor.execute(f"SHOW FULL COLUMNS FROM {table} LIKE '{name}'")
            _, _, _, nullable, _, default, _, _, comment = cursor.fetchone()
            longest = before.get(name, 255)
            null = "NULL" if nullable == "YES" else "NOT NULL" if default is None else "NOT NULL DEFAULT ''"
            said = comment.replace("varchar(1000)", f"varchar({longest})")
            cursor.execute(f"ALTER TABLE {table} MODIFY COLUMN {name} VARCHAR({longest}) {null} COMMENT %s", (said,))
