"""What runs first in a program of ours: Ctrl-C that always stops, and libraries that neither talk nor spin in between.

Modules are imported by functions, so that next to nothing is loaded before Ctrl-C is looked after.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from types import FrameType

LATER = 0.05
"""Time after which an interrupt that came during an import is tried again [s]."""


def beam() -> int:
    """Run ``beam``."""
    return _run("beam_warp.cli.main")


def beam_convert() -> int:
    """Run ``beam-convert``."""
    return _run("beam_warp.cli.convert")


def beam_validate() -> int:
    """Run ``beam-validate``."""
    return _run("beam_warp.cli.validate")


def _run(module: str) -> int:
    """Import a command and run it; returns the exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else whoever started us wants no interrupts
        signal.signal(signal.SIGINT, interrupt)
    # Before NumPy is loaded. Our matrices are small and many, and threads of BLAS would spin to wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(5_000)  # else garbage is looked for in a thousand modules while they are loaded
    try:
        return with_streams_of_our_own(lambda: import_module(module).main())
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, but never inside an import: extension modules lose it there, and the job would go on."""
    import threading

    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            timer = threading.Timer(LATER, _again, (number,))
            timer.daemon = True
            timer.start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _again(number: int) -> None:
    """Interrupt the main thread from another one, also where it sleeps."""
    import threading

    if sys.platform == "win32":
        signal.raise_signal(number)
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, number)


def with_streams_of_our_own(work: Callable[[], int]) -> int:
    """Run a command while Python alone writes to the terminal; returns the exit code.

    What OpenEXR, OpenUSD and others write natively about a damaged file, on standard output too, goes to a file. It is
    shown in the end, unless the exit code is 2: then our own line has said it. Characters that the terminal's encoding
    lacks are escaped.
    """
    import shutil
    import tempfile
    from contextlib import suppress

    if sys.stdout is None or sys.stderr is None:
        return work()
    streams, code = (sys.stdout, sys.stderr), None
    kept = [os.dup(stream.fileno()) for stream in streams]
    with tempfile.TemporaryFile() as noise:
        try:
            sys.stdout, sys.stderr = own = [_writer(*pair) for pair in zip(kept, streams, strict=True)]
            for stream in streams:
                os.dup2(noise.fileno(), stream.fileno())
            try:
                code = work()
                return code
            finally:
                sys.stdout, sys.stderr = streams
                for writer in own:
                    with suppress(OSError):  # nobody reads any more
                        writer.close()
        finally:
            for descriptor, stream in zip(kept, streams, strict=True):
                os.dup2(descriptor, stream.fileno())
                os.close(descriptor)
            noise.seek(0)
            if code != 2:
                shutil.copyfileobj(noise, streams[1].buffer)
                streams[1].flush()


def _writer(descriptor: int, like: TextIO) -> TextIO:
    """Return a stream like another one, to another descriptor, which stays open."""
    buffering = 1 if like.isatty() or like is sys.stderr else -1
    return open(descriptor, "w", buffering, like.encoding, "backslashreplace", closefd=False)
