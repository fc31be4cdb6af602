"""Threads of the linear algebra library while fits are solved."""

from contextlib import ExitStack

from threadpoolctl import ThreadpoolController

from pbl_pipeline.fit.blas_threads import one_blas_thread


def threads() -> set[int]:
    return {library["num_threads"] for library in ThreadpoolController().select(user_api="blas").info()}


def test_two_fits_at_a_time_leave_the_number_that_was_there():
    with ThreadpoolController().limit(limits=2, user_api="blas"):
        before, first, second = threads(), ExitStack(), ExitStack()
        first.enter_context(one_blas_thread())
        second.enter_context(one_blas_thread())
        first.close()
        assert threads() == {1}  # the second one is still at work
        second.close()
        assert threads() == before == {2}
