"""Signals that stop a run: at once, or where it can be taken up again.

    anywhere              the first signal raises `Stopped`; those that come while it makes its way
                          to the end are left alone, as a closed terminal sends two
    with deferred():      the first waits for `check`, at the border of a step; the second raises
    with whole():         all wait for the end of the block, which is short and leaves nothing half

Python handles a signal when the call into native code that it met has returned. Nothing can be
raised out of a destructor; what is raised in one is raised again as soon as it has ended. A library
may swallow an exception that a handler raises; a signal that came is therefore remembered, and the
next `check` raises again.
"""

import _thread
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
UNWINDING_SECONDS = 2.0
"""After that long a `Stopped` has been swallowed, or waits for something: a signal raises again."""

AGAIN_SECONDS = 0.01
"""How soon after a destructor swallowed a `Stopped` another one is raised."""


class Stopped(KeyboardInterrupt):
    """A signal has stopped the run; whatever is staged or locked is cleaned up on its way.

    Args:
        number: Of the first signal that came.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number
        self.kept = ""
        """What is left of the run and how to go on, for the last line that is printed."""


@dataclass
class _State:
    number: int = 0
    """The first signal."""
    count: int = 0
    """Signals that came."""
    deferring: int = 0
    whole: int = 0
    raised: float = -math.inf
    """When one was last raised [s], by a clock that only runs forward."""


_state = _State()


@contextmanager
def handled() -> Iterator[None]:
    """Handle the signals of `STOPPING` within the block; what the parent ignores stays ignored.

    Only the main thread of a process can; in another one the block runs as it is.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _forget()
    before = {number: signal.getsignal(number) for number in STOPPING}
    own = {n: old for n, old in before.items() if old not in (signal.SIG_IGN, None)}
    for number in own:
        signal.signal(number, _receive)
    other_faults = sys.unraisablehook

    def report(fault: "sys.UnraisableHookArgs") -> None:
        if fault.exc_type is not Stopped:
            other_faults(fault)
            return
        _state.raised = -math.inf
        again = threading.Timer(AGAIN_SECONDS, _raise_again, (_state,))
        again.daemon = True
        again.start()

    sys.unraisablehook = report
    try:
        yield
    finally:
        sys.unraisablehook = other_faults
        for number, old in own.items():
            signal.signal(number, old)
        _forget()


@contextmanager
def deferred() -> Iterator[None]:
    """Let the first signal wait for `check`; the end of the block checks too.

    Raises:
        Stopped: A signal came.
    """
    _state.deferring += 1
    try:
        yield
    finally:
        _state.deferring -= 1
    check()


@contextmanager
def whole() -> Iterator[None]:
    """Let all signals wait for the end of the block.

    Raises:
        Stopped: One came within, and nothing outside of the block defers it.
    """
    before = _state.count
    _state.whole += 1
    try:
        yield
    finally:
        _state.whole -= 1
    is_deferred = _state.deferring and _state.count == 1
    if _state.count > before and not is_deferred and not _state.whole:
        raise Stopped(_state.number)


def is_pending() -> bool:
    """Return whether a signal has come."""
    return _state.count > 0


def check() -> None:
    """Stop here if a signal has come.

    Raises:
        Stopped: One has.
    """
    if _state.count:
        raise Stopped(_state.number)


def ignore_at_exit() -> None:
    """Let no signal turn a run that has ended into one that was killed: its status is decided."""
    if threading.current_thread() is threading.main_thread():
        for number in STOPPING:
            signal.signal(number, signal.SIG_IGN)


def ignore() -> None:
    """Let no further signal interrupt the few lines that say why the run ends."""
    if threading.current_thread() is threading.main_thread():  # that alone is interrupted
        _state.whole += 1


def _forget() -> None:
    global _state
    _state = _State()


def _raise_again(state: _State) -> None:
    """Let the main thread receive a block's signal once more, if the block has not ended."""
    if state is _state:
        _thread.interrupt_main(signal.Signals(state.number))


def _receive(number: int, frame: FrameType | None) -> None:
    _state.number = _state.number or number
    _state.count += 1
    if _state.whole:
        return
    if _state.deferring and _state.count == 1:
        # Not print: the signal may have come in the middle of one.
        os.write(2, b"stopping at the end of this step; a second signal stops at once\n")
        return
    now = time.monotonic()
    if now - _state.raised > UNWINDING_SECONDS:
        _state.raised = now
        raise Stopped(_state.number)
