"""Many sessions on their way through a solver: threads that pack them, solve them and make their results."""

from __future__ import annotations

import bisect
import contextlib
import dataclasses
import threading
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from pbl_pipeline.errors import PblError
from pbl_pipeline.methods import Method

from .params import Params
from .problem import State
from .results import SessionFit
from .session import Session
from .solution import Solution

#: Sessions of the same sizes that are enough for a solver to begin: it takes more as they are packed, of which at most
#: twice as many wait.
FIRST = 16

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Packed:
    """A session ready for a solver, with its start; `seconds`: time that packing took; `kind`: the same for sessions of
    the same sizes and terms, which a solver can take together."""

    index: int
    session: Session
    start: State
    seconds: float
    kind: Hashable


class Work:
    """The sessions of a call on their way through its threads: those that pack also make the results of what the
    others have solved. An error of `pack` or `finish` is the result of its session."""

    def __init__(
        self,
        n: int,
        pack: Callable[[int], Packed],
        method: Method[Params],
        finish: Callable[[Packed, Solution], SessionFit],
        most: int,
    ) -> None:
        """n: number of sessions. most: that a call of the method takes."""
        self.n, self.pack, self.method, self.finish, self.most = n, pack, method, finish, most
        self.enough = min(most, FIRST)
        self.out: list[SessionFit | PblError | None] = [None] * n
        #: Guards what follows.
        self.changed = threading.Condition()
        self.to_pack = deque(range(n))
        self.packing = 0
        self.packed = dict[Hashable, list[Packed]]()
        self.taken_by = Counter[Hashable]()  # solvers that take sessions of a kind
        self.solved = deque[tuple[Packed, Solution | PblError]]()
        self.left = n  # without a result
        self.failed = False

    def run(self, solvers: int, packers: int) -> list[SessionFit | PblError]:
        """Return the results, in the order of the sessions. solvers, packers: how many threads."""
        jobs = [self.solve] * solvers + [self.pack_and_finish] * packers
        with ThreadPoolExecutor(len(jobs)) as pool, self.ends_with_error():
            for ended in [pool.submit(self.guarded, job) for job in jobs]:
                ended.result()  # raises what was raised there
        return [r for r in self.out if r is not None]

    @contextlib.contextmanager
    def ends_with_error(self) -> Iterator[None]:
        """An error inside ends all threads."""
        try:
            yield
        except BaseException:
            with self.changed:
                self.failed = True
                self.changed.notify_all()
            raise

    def guarded(self, job: Callable[[], None]) -> None:
        with self.ends_with_error():
            job()

    @property
    def _over(self) -> bool:
        return self.failed or not self.left

    @property
    def _full(self) -> bool:
        return sum(map(len, self.packed.values())) + self.packing >= 2 * self.enough

    def pack_and_finish(self) -> None:
        """Make results where a solution waits, else pack the next session."""
        while True:
            with self.changed:
                self.changed.wait_for(lambda: self._over or self.solved or (self.to_pack and not self._full))
                if self._over:
                    return
                given = self.solved.popleft() if self.solved else None
                self.packing += given is None
                i = given[0].index if given else self.to_pack.popleft()
            done = self._done(i, given)
            with self.changed:
                self.packing -= given is None
                if isinstance(done, Packed):
                    # In their order, not that in which the threads are done with them.
                    bisect.insort(self.packed.setdefault(done.kind, []), done, key=lambda packed: packed.index)
                else:
                    self.out[i] = done
                    self.left -= 1
                self.changed.notify_all()

    def _done(self, i: int, given: tuple[Packed, Solution | PblError] | None) -> Packed | SessionFit | PblError:
        """Pack a session, or make the result of a given solution."""
        try:
            if given is None:
                return self.pack(i)
            packed, solution = given
            return solution if isinstance(solution, PblError) else self.finish(packed, solution)
        except PblError as error:
            return error

    def solve(self) -> None:
        """Give the solver sessions of one kind after the other."""
        while (begin := self._begin_kind()) is not None:
            self._solve_kind(begin)

    def _begin_kind(self) -> Packed | None:
        """One of the kind of which most are packed, once these are enough; or all there will be, of a kind that no
        other solver is taking. None at the end."""

        def kinds() -> list[Hashable]:
            last = self._full or not (self.to_pack or self.packing)
            return [k for k, p in self.packed.items() if len(p) >= self.enough or (last and not self.taken_by[k])]

        with self.changed:
            self.changed.wait_for(lambda: self._over or kinds())
            if self._over:
                return None
            kind = max(kinds(), key=lambda k: len(self.packed[k]))
            self.taken_by[kind] += 1
            return self._take(kind)

    def _take(self, kind: Hashable) -> Packed | None:
        """One that is packed now."""
        with self.changed:
            waiting = self.packed.get(kind)
            if not waiting or self.failed:
                return None
            out = waiting.pop(0)
            if not waiting:
                del self.packed[kind]
            self.changed.notify_all()
            return out

    def _solve_kind(self, begin: Packed) -> None:
        """Give the solver a session, and others of its kind as long as it asks and they are packed."""
        kind, taken, unsolved, starts = begin.kind, 0, deque[Packed](), deque[State]()

        def take() -> Session | None:
            nonlocal taken
            packed = begin
            if taken == self.most:
                return None
            if taken and (packed := self._take(kind)) is None:
                return None
            taken += 1
            unsolved.append(packed)
            starts.append(packed.start)
            return packed.session

        sessions = _Ready(take, min(self.most, self.n))
        beside = _Ready(lambda: starts.popleft() if starts else None)
        try:
            for solution in self.method.function(sessions, self.method.params, beside):
                with self.changed:
                    if not unsolved:
                        raise self._miscounted()
                    self.solved.append((unsolved.popleft(), solution))
                    self.changed.notify_all()
        finally:
            with self.changed:
                self.taken_by[kind] -= 1
                self.changed.notify_all()
        if (unsolved or not taken) and not self.failed:
            raise self._miscounted()

    def _miscounted(self) -> ValueError:
        return ValueError(f"{self.method.key} did not return a solution or an error for each session that it took")


class _Ready(Iterator[T]):
    """What is ready: ends where nothing is, and may have more when it is asked again, up to `most`."""

    def __init__(self, take: Callable[[], T | None], most: int = 0) -> None:
        self._take, self._most = take, most

    def __next__(self) -> T:
        if (item := self._take()) is None:
            raise StopIteration
        return item

    def __length_hint__(self) -> int:
        return self._most
