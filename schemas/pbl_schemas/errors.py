"""Error codes of the tables."""

from pbl_pipeline.errors import CALL, INPUT, MACHINE, Code, register

register(
    {
        "VIDEO_DUPLICATE": Code(
            INPUT, "the same bytes are registered for another person, or, from a phone, in another visit"
        ),
        "UPLOAD_REFUSED": Code(CALL, "what was uploaded is not a recording that may be taken over"),
        "PHONE_LINK": Code(CALL, "a link for filming is unknown, ended, or belongs to another phone"),
        "SHEET_CONFLICT": Code(INPUT, "rows of a sheet contradict each other, or what is registered"),
        "SCORE_RANGE": Code(INPUT, "a clinical score has a value that its instrument cannot have"),
        "DB_NOT_RUNNING": Code(MACHINE, "the database does not answer"),
        "DB_UNAVAILABLE": Code(MACHINE, "no database server can be obtained on this machine"),
        "DB_REFUSED": Code(MACHINE, "the database answers but refuses the login or the operation"),
        "DB_NOT_FOUND": Code(CALL, "a row that was named does not exist"),
        "DB_MIGRATION": Code(MACHINE, "the tables on the server are not as this version of the code declares them"),
        "INPUT_CHANGED": Code(MACHINE, "rows that a computation reads are gone, or changed each time it ran"),
        "NOT_QUEUED": Code(MACHINE, "it is stored, but what is to be computed then could not be queued yet"),
        "STORE_UNAVAILABLE": Code(MACHINE, "the store of the arrays cannot be reached, or refuses"),
        "STORE_FULL": Code(MACHINE, "the store of the arrays has no room left"),
        "BACKUP_INVALID": Code(INPUT, "a backup is incomplete or was changed"),
        "DECIDED_MEANWHILE": Code(CALL, "another person decided, or it was computed again, since the page was loaded"),
    }
)
