"""Error codes of workers and pages."""

from pbl_pipeline.errors import CALL, MACHINE, Code, register

register(
    {
        "TIME_LIMIT": Code(MACHINE, "a job took longer than a worker gives it and was ended"),
        "WORKER_CRASH": Code(MACHINE, "a job took its worker's process down more than once"),
        "WEB_NOT_MADE": Code(MACHINE, "a file that the review page was making was not finished"),
        "WEB_REFUSED": Code(
            CALL, "a request to the review page may not be answered: no session, no right, or a form of another page"
        ),
        "WEB_PORT": Code(MACHINE, "the review page cannot listen on that port"),
        "WEB_TLS": Code(
            MACHINE, "the review page would be reached without encryption, or its certificate cannot be used"
        ),
        "WEB_ACCOUNT": Code(CALL, "an account of the review page is not there, or cannot be as it was asked for"),
    }
)
