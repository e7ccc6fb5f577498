"""Shares of one work on several threads, the caller's own among them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait


class Threads:
    """``workers`` threads for a work that comes in as many shares.

    Waking a thread takes some 50 us, so the caller's thread takes a share itself: it would only
    wait. With one worker no thread is ever begun.
    """

    def __init__(self, workers: int) -> None:
        self._pool = ThreadPoolExecutor(workers - 1) if workers > 1 else None

    def __call__(self, work: Callable[..., None], shares: Sequence[tuple]) -> None:
        """Call ``work(*share)`` for each; raise what one raised, when all have ended."""
        if self._pool is None:
            for share in shares:
                work(*share)
            return
        others = [self._pool.submit(work, *share) for share in shares[1:]]
        try:
            work(*shares[0])
        finally:
            wait(others)
        for other in others:
            other.result()
