"""How a local worker begins: it leaves interrupts to the process that asked, and ends with it.

Loads nothing that is slow: a worker whose parent is killed while it is still loading ends too.
"""

from __future__ import annotations

import os
import signal
import threading
import time

_WATCH_S = 0.5


def begin(parent: int) -> None:
    """Called first in each worker of the process ``parent``."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    """However the parent goes, nobody waits for the work any more."""
    while os.getppid() == parent:
        time.sleep(_WATCH_S)
    os._exit(1)
