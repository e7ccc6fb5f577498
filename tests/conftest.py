"""What all tests stand on."""

from __future__ import annotations

import signal

# A shell's background job ignores SIGINT, and its children would: what Ctrl-C does is tested.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
